//! Where a run begins: at its own newest checkpoint, with parameters of another run, or anew.

use anyhow::{Context, ensure};
use isodream_core::config::LearnerConfig;
use isodream_model::Agent;

use crate::LearnerOptions;
use crate::checkpoint::{Checkpoint, Counters};

/// The newest checkpoint of a run directory, known to belong to the run; none where the run begins.
pub(crate) struct Beginning {
    checkpoint: Option<Checkpoint>,
}

impl Beginning {
    /// Looks for a checkpoint of this run.
    ///
    /// # Errors
    /// Where there are checkpoints but none is valid, or the newest is of another environment or model.
    pub(crate) fn find(options: &LearnerOptions) -> anyhow::Result<Self> {
        let checkpoint = Checkpoint::load_newest(&options.run_dir.join("checkpoints"))?;
        if let Some(checkpoint) = &checkpoint {
            check_belongs(checkpoint, options)?;
        }
        Ok(Self { checkpoint })
    }

    /// Whether the run goes on from a checkpoint.
    pub(crate) fn is_resumed(&self) -> bool {
        self.checkpoint.is_some()
    }

    /// What was counted up to here.
    pub(crate) fn counters(&self) -> Counters {
        self.checkpoint
            .as_ref()
            .map(|checkpoint| checkpoint.counters.clone())
            .unwrap_or_default()
    }

    /// The agent as it was at the checkpoint, or a new one with what `learner.initial` gives it.
    ///
    /// # Errors
    /// Where the tensors of the checkpoint, or of the run to begin with, do not fit the configuration.
    pub(crate) fn agent(self, options: &LearnerOptions) -> anyhow::Result<Agent> {
        let config = &options.config;
        let mut agent = Agent::new(config, &options.spec, options.device);
        if let Some(Checkpoint {
            counters,
            model,
            optimizer,
            ..
        }) = self.checkpoint
        {
            agent
                .load(&model, &optimizer, counters.updates)
                .context("the checkpoint does not fit this configuration")?;
            tracing::info!(updates = counters.updates, "resumed from checkpoint");
        } else if !config.learner.initial.is_empty() {
            transfer(&mut agent, &config.learner)?;
        }
        Ok(agent)
    }
}

/// Refuses a checkpoint of another environment or model, by name.
fn check_belongs(checkpoint: &Checkpoint, options: &LearnerOptions) -> anyhow::Result<()> {
    let spec = options.spec.to_string();
    ensure!(
        checkpoint.env_spec == spec,
        "the checkpoint in {} is of environment {}, this run is of {spec}; choose another --run-dir",
        options.run_dir.display(),
        checkpoint.env_spec
    );
    ensure!(
        checkpoint.config.model_hash() == options.config.model_hash(),
        "the checkpoint in {} has other [model] settings than this run; choose another --run-dir or the old settings",
        options.run_dir.display()
    );
    Ok(())
}

/// Gives a new agent parameters of another run.
fn transfer(agent: &mut Agent, config: &LearnerConfig) -> anyhow::Result<()> {
    let from = Checkpoint::find(config.initial.as_ref()).context("learner.initial")?;
    let taken = agent
        .transfer(&from.model, &config.initial_parts)
        .with_context(|| format!("learner.initial: {} does not fit this run", config.initial))?;
    ensure!(
        taken > 0,
        "learner.initial_parts: no parameter has one of {:?} in its name; write for example noncontrollable",
        config.initial_parts
    );
    tracing::info!(
        taken,
        from = config.initial,
        updates = from.counters.updates,
        "transferred parameters"
    );
    Ok(())
}
