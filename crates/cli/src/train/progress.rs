//! What people see while a run trains: a line per role, and why anything waits.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use isodream_core::Config;
use isodream_dashboard::{LearnerView, ReplayView, Sources};

use super::processes::{Process, Processes};

/// Pause between two lines where there is no terminal to draw on.
const PLAIN_INTERVAL: Duration = Duration::from_secs(15);

/// Asks the roles how they are and draws their answers.
pub(crate) struct Progress {
    bars: MultiProgress,
    lines: Vec<ProgressBar>,
    sources: Sources,
    total_updates: u64,
    action_repeat: u64,
    terminal: bool,
    next_plain: Instant,
    answers: Answers,
}

/// The newest answers; none from a role that has never been up.
#[derive(Default)]
struct Answers {
    learner: Option<LearnerView>,
    replay: Option<ReplayView>,
}

impl Progress {
    pub(crate) fn new(config: &Config, sources: Sources) -> Self {
        Self {
            bars: MultiProgress::new(),
            lines: Vec::new(),
            sources,
            total_updates: config.total_updates(),
            action_repeat: u64::from(config.env.action_repeat),
            terminal: std::io::stderr().is_terminal(),
            next_plain: Instant::now() + PLAIN_INTERVAL,
            answers: Answers::default(),
        }
    }

    /// Renews the display.
    pub(crate) async fn refresh(&mut self, processes: &Processes) {
        if !self.terminal && Instant::now() < self.next_plain {
            return;
        }
        let live = self.sources.ask().await;
        // A role that is being restarted keeps its last words on the screen.
        self.answers.learner = live.learner.or(self.answers.learner.take());
        let replay = live.replay.into_iter().find(|replay| replay.up);
        self.answers.replay = replay.or(self.answers.replay.take());
        if self.terminal {
            self.draw(processes);
        } else {
            self.next_plain = Instant::now() + PLAIN_INTERVAL;
            for process in processes.iter() {
                let line = self.line(process);
                eprintln!("{:<10} {line}", process.name());
            }
        }
    }

    /// Leaves the last state on the screen.
    pub(crate) fn close(&self) {
        for line in &self.lines {
            line.abandon();
        }
    }

    fn draw(&mut self, processes: &Processes) {
        for (index, process) in processes.iter().enumerate() {
            if index == self.lines.len() {
                let template = match process.name() {
                    "learner" => "{prefix:<10} [{bar:24}] {wide_msg}",
                    _ => "{prefix:<10} {wide_msg}",
                };
                let style = ProgressStyle::with_template(template)
                    .unwrap_or_else(|_| ProgressStyle::default_bar());
                let bar = self.bars.add(
                    ProgressBar::new(self.total_updates).with_style(style.progress_chars("=> ")),
                );
                bar.set_prefix(process.name().to_owned());
                self.lines.push(bar);
            }
            let bar = &self.lines[index];
            if let Some(learner) = &self.answers.learner {
                bar.set_position(learner.updates);
            }
            bar.set_message(self.line(process));
            bar.tick();
        }
    }

    fn line(&self, process: &Process) -> String {
        let answers = &self.answers;
        let said = match process.name() {
            "replay" => answers
                .replay
                .as_ref()
                .map(|status| self.replay_line(status)),
            "learner" => answers.learner.as_ref().map(learner_line),
            name => answers
                .learner
                .as_ref()
                .and_then(|status| actor_line(status, name)),
        };
        let said = said.unwrap_or_else(|| "no word yet".into());
        match process.trouble() {
            Some(trouble) => format!("{said}  ({trouble})"),
            None => said,
        }
    }

    fn replay_line(&self, status: &ReplayView) -> String {
        let mut line = format!(
            "{} frames  {} steps in {} episodes  {:.0} MB",
            status.inserted_steps * self.action_repeat,
            status.steps,
            status.episodes,
            status.bytes as f64 / 1e6
        );
        for (side, why) in [
            ("inserts wait", &status.insert_waiting),
            ("samples wait", &status.sample_waiting),
        ] {
            // The numbers behind the reason are in the status; a line has no room for them.
            let reason = why.split(':').next().unwrap_or_default();
            if !reason.is_empty() {
                line += &format!("  {side}: {reason}");
            }
        }
        line
    }
}

fn learner_line(status: &LearnerView) -> String {
    format!(
        "{}/{} updates  {:.1}/s  return {}  eval {}  waited {:.0}%  {}",
        status.updates,
        status.total_updates,
        status.updates_per_s,
        score(status.collect_score),
        score(status.evaluate_score),
        100.0 * status.wait_share,
        status.phase
    )
}

fn actor_line(status: &LearnerView, name: &str) -> Option<String> {
    let actor = status.actors.iter().find(|actor| actor.id == name)?;
    Some(format!(
        "{} episodes  {} frames  last return {:.1}  policy lag {} updates",
        actor.episodes, actor.env_frames, actor.last_score, actor.policy_lag
    ))
}

fn score(value: Option<f64>) -> String {
    value.map_or_else(|| "-".into(), |value| format!("{value:.1}"))
}
