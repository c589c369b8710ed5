//! What values settings may have.

use super::load::ConfigError;
use super::{Branches, Config, InverseInput};

impl Config {
    /// Refuses the first setting that is out of range.
    pub(super) fn check(&self) -> Result<(), ConfigError> {
        let positive = [
            ("env.action_repeat", f64::from(self.env.action_repeat)),
            ("env.time_limit", f64::from(self.env.time_limit)),
            ("model.cnn_depth", self.model.cnn_depth as f64),
            ("model.deter", self.model.deter as f64),
            ("model.stoch", self.model.stoch as f64),
            ("model.hidden", self.model.hidden as f64),
            ("model.units", self.model.units as f64),
            ("model.min_std", self.model.min_std),
            ("actor.threads", f64::from(self.actor.threads)),
            ("optimizer.model_lr", self.optimizer.model_lr),
            ("optimizer.actor_lr", self.optimizer.actor_lr),
            ("optimizer.critic_lr", self.optimizer.critic_lr),
            ("optimizer.grad_clip", self.optimizer.grad_clip),
            ("model.attention_dim", self.model.attention_dim as f64),
            ("model.encoder_frames", self.model.encoder_frames as f64),
            (
                "model.background_frames",
                self.model.background_frames as f64,
            ),
            ("model.policy_min_std", self.model.policy_min_std),
            ("loss.decoded_share", self.loss.decoded_share),
            ("optimizer.final_share", self.optimizer.final_share),
            (
                "behavior.slow_critic_fraction",
                self.behavior.slow_critic_fraction,
            ),
            ("learner.workers", self.learner.workers as f64),
            ("learner.batch_size", self.learner.batch_size as f64),
            ("learner.replay_ratio", self.learner.replay_ratio),
            ("learner.decode_threads", self.learner.decode_threads as f64),
            (
                "learner.prefetch_batches",
                self.learner.prefetch_batches as f64,
            ),
            (
                "learner.publish_interval",
                self.learner.publish_interval as f64,
            ),
            (
                "learner.checkpoint_interval",
                self.learner.checkpoint_interval as f64,
            ),
            ("learner.stop_secs", self.learner.stop_secs),
            ("learner.log_interval", self.learner.log_interval as f64),
            (
                "behavior.slow_critic_interval",
                self.behavior.slow_critic_interval as f64,
            ),
            ("behavior.start_share", self.behavior.start_share),
            ("behavior.start_weight", self.behavior.start_weight),
            ("replay.chunk_steps", self.replay.chunk_steps as f64),
            ("replay.segment_bytes", self.replay.segment_bytes as f64),
            ("actor.environments", self.actor.environments as f64),
            ("actor.spool_chunks", self.actor.spool_chunks as f64),
            ("actor.spool_mb", self.actor.spool_mb as f64),
            (
                "actor.evaluate_episodes",
                f64::from(self.actor.evaluate_episodes),
            ),
        ];
        for (key, value) in positive {
            if value.is_nan() || value <= 0.0 {
                return Err(invalid(key, "must be greater than 0"));
            }
        }
        let shares = [
            (
                "loss.controllable_posterior_share",
                self.loss.controllable_posterior_share,
            ),
            (
                "loss.noncontrollable_posterior_share",
                self.loss.noncontrollable_posterior_share,
            ),
            ("loss.kl_balance", self.loss.kl_balance),
            ("actor.explore_share", self.actor.explore_share),
            ("actor.greedy_share", self.actor.greedy_share),
            ("loss.gate_share", self.loss.gate_share),
            ("optimizer.final_share", self.optimizer.final_share),
            ("loss.decoded_share", self.loss.decoded_share),
            (
                "behavior.slow_critic_fraction",
                self.behavior.slow_critic_fraction,
            ),
            ("behavior.greedy_share", self.behavior.greedy_share),
            ("behavior.discount", self.behavior.discount),
            ("behavior.lambda", self.behavior.lambda),
        ];
        for (key, value) in shares {
            if !(0.0..=1.0).contains(&value) {
                return Err(invalid(key, "must lie between 0 and 1"));
            }
        }
        let background = self.model.background_frames as usize;
        if self.learner.batch_length < background.max(2) {
            return Err(invalid(
                "learner.batch_length",
                &format!("must be at least 2 and at least model.background_frames ({background})"),
            ));
        }
        if self.learner.batch_length > self.env.time_limit as usize + 1 {
            return Err(invalid(
                "learner.batch_length",
                "must not be longer than an episode (env.time_limit + 1)",
            ));
        }
        if ![32, 64].contains(&self.env.image_size) {
            return Err(invalid(
                "env.image_size",
                "must be 32 or 64, the sizes the networks are made for",
            ));
        }
        if self.behavior.imagination_horizon < 2 {
            return Err(invalid(
                "behavior.imagination_horizon",
                "must be at least 2",
            ));
        }
        if self.behavior.rollout_window < 0 {
            return Err(invalid("behavior.rollout_window", "must not be negative"));
        }
        if self.model.inverse == InverseInput::Embed && self.model.encoder_actions {
            return Err(invalid(
                "model.inverse",
                "embed needs model.encoder_actions = false: else the embeddings contain the action that is to be inferred",
            ));
        }
        if self.model.branches == Branches::Controllable && self.model.indicator {
            return Err(invalid(
                "model.indicator",
                "must be false where model.branches has no noncontrollable one",
            ));
        }
        let tolerance = self.replay.limiter_tolerance_batches;
        if tolerance.is_nan() || tolerance < 1.0 {
            return Err(invalid(
                "replay.limiter_tolerance_batches",
                "must be at least 1",
            ));
        }
        self.check_tables()?;
        if self.learner.threads < 0 {
            return Err(invalid("learner.threads", "must not be negative"));
        }
        if self.total_updates() == 0 {
            return Err(invalid(
                "learner.env_frames",
                "must leave agent steps after learner.prefill_steps, or nothing is trained",
            ));
        }
        if self.behavior.start_share > 1.0 {
            return Err(invalid("behavior.start_share", "must not exceed 1"));
        }
        if self.learner.keep_checkpoints < 2 {
            return Err(invalid("learner.keep_checkpoints", "must be at least 2"));
        }
        Ok(())
    }

    fn check_tables(&self) -> Result<(), ConfigError> {
        for (name, table) in &self.replay.tables {
            let key = |field: &str| format!("replay.tables.{name}.{field}");
            if !(table.priority_exponent >= 0.0 && table.priority_exponent.is_finite()) {
                return Err(invalid(&key("priority_exponent"), "must be 0 or greater"));
            }
            if table.newest == 0 {
                return Err(invalid(&key("newest"), "must be at least 1"));
            }
            for (field, share) in [
                ("ends_share", table.ends_share),
                ("newest_share", table.newest_share),
            ] {
                if !(0.0..=1.0).contains(&share) {
                    return Err(invalid(&key(field), "must lie between 0 and 1"));
                }
            }
        }
        if !self.replay.tables.contains_key(&self.learner.table) {
            let known: Vec<_> = self.replay.tables.keys().map(String::as_str).collect();
            return Err(invalid(
                "learner.table",
                &format!(
                    "must name a table of [replay.tables], one of: {}",
                    known.join(", ")
                ),
            ));
        }
        Ok(())
    }
}

fn invalid(key: &str, message: &str) -> ConfigError {
    ConfigError::Invalid {
        origin: key.to_owned(),
        message: message.to_owned(),
    }
}
