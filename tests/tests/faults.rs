//! Roles are killed in mid-run, and the run goes on without losing anything it had acknowledged.

use std::path::Path;
use std::time::Duration;

use anyhow::{Result, ensure};
use isodream_learner::checkpoint::Checkpoint;
use isodream_tests::{Running, free_address, learner_status, replay_status, until};

const SOON: Duration = Duration::from_secs(60);
const LATER: Duration = Duration::from_secs(180);

/// A run of the debug preset whose roles are started one by one.
struct Run {
    folder: tempfile::TempDir,
    replay: String,
    learner: String,
}

impl Run {
    fn new() -> Result<Self> {
        Ok(Self {
            folder: tempfile::tempdir()?,
            replay: free_address()?,
            learner: free_address()?,
        })
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).display().to_string()
    }

    fn start_replay(&self) -> Result<Running> {
        Running::start(&[
            "replay",
            "--preset",
            "debug",
            "--dir",
            &self.path("replay"),
            "--listen",
            &self.replay,
        ])
    }

    fn start_learner(&self) -> Result<Running> {
        let run_dir = self.path("");
        let addresses = ["--listen", &self.learner, "--replay", &self.replay];
        Running::start(
            &[
                &["learner", "--preset", "debug", "--run-dir", &run_dir],
                &addresses[..],
            ]
            .concat(),
        )
    }

    fn start_actor(&self, id: &str, role: &str) -> Result<Running> {
        let addresses = ["--learner", &self.learner, "--replay", &self.replay];
        Running::start(
            &[
                &["actor", "--preset", "debug", "--id", id, "--role", role],
                &addresses[..],
            ]
            .concat(),
        )
    }

    fn wait_for_updates(&self, updates: u64) -> Result<u64> {
        until(
            &format!("the learner has made {updates} updates"),
            LATER,
            || {
                Ok(learner_status(&self.learner)?
                    .map(|s| s.updates)
                    .filter(|&made| made >= updates))
            },
        )
    }
}

fn checkpointed_updates(run_dir: &Path) -> Result<u64> {
    Ok(Checkpoint::find(run_dir)?.counters.updates)
}

#[test]
fn a_run_survives_the_death_of_every_role() -> Result<()> {
    let run = Run::new()?;
    let replay = run.start_replay()?;
    let learner = run.start_learner()?;
    let first = run.start_actor("actor-0", "collect")?;
    let second = run.start_actor("actor-1", "collect")?;
    let _evaluator = run.start_actor("evaluator", "evaluate")?;
    run.wait_for_updates(21)?;

    first.kill()?;
    let replacement = run.start_actor("actor-0", "collect")?;
    let before = run.wait_for_updates(25)?;

    learner.kill()?;
    let resumed_from = checkpointed_updates(run.folder.path())?;
    ensure!(
        resumed_from > 0 && resumed_from <= before,
        "checkpoint at {resumed_from}, killed at {before}"
    );
    let mut learner = run.start_learner()?;
    let status = until("the learner is back", SOON, || learner_status(&run.learner))?;
    ensure!(
        status.updates >= resumed_from && status.updates <= before + 1,
        "the learner began again at {} instead of {resumed_from}",
        status.updates
    );
    run.wait_for_updates(before + 5)?;

    // With the actors gone nothing is inserted, so that what is held can be compared exactly.
    replacement.kill()?;
    second.kill()?;
    let held = until("replay answers", SOON, || replay_status(&run.replay))?;
    replay.kill()?;
    let _replay = run.start_replay()?;
    let again = until("replay answers", SOON, || replay_status(&run.replay))?;
    ensure!(
        (
            again.inserted_steps,
            again.steps,
            again.episodes,
            again.quarantined_records
        ) == (held.inserted_steps, held.steps, held.episodes, 0),
        "before the kill {held:?}, after it {again:?}"
    );
    let _first = run.start_actor("actor-0", "collect")?;
    let _second = run.start_actor("actor-1", "collect")?;

    ensure!(learner.wait(LATER)?.success(), "the learner ends well");
    let finished = checkpointed_updates(run.folder.path())?;
    ensure!(finished > before + 5, "{finished} updates at the end");
    let metrics = std::fs::read_to_string(run.folder.path().join("metrics.jsonl"))?;
    for name in [
        "train/loss/model",
        "episode/score",
        "eval/score",
        "fps/train",
    ] {
        ensure!(metrics.contains(name), "metrics.jsonl has no {name}");
    }
    Ok(())
}
