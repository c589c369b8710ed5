//! Roles are killed in mid-run, and the run goes on without losing anything it had acknowledged.

use std::io::{Read, Write};
use std::path::Path;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use isodream_learner::checkpoint::Checkpoint;
use isodream_tests::{Running, free_address, learner_status, replay_status, until};

const SOON: Duration = Duration::from_secs(60);
const LATER: Duration = Duration::from_secs(180);

/// A run of the debug preset whose roles are started one by one.
struct Run {
    folder: tempfile::TempDir,
    replay: String,
    metrics: String,
    learner: String,
}

impl Run {
    fn new() -> Result<Self> {
        Ok(Self {
            folder: tempfile::tempdir()?,
            replay: free_address()?,
            metrics: free_address()?,
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
            "--metrics-listen",
            &self.metrics,
        ])
    }

    fn start_learner(&self) -> Result<Running> {
        self.start_learner_with(&[])
    }

    fn start_learner_with(&self, settings: &[&str]) -> Result<Running> {
        let run_dir = self.path("");
        let addresses = ["--listen", &self.learner, "--replay", &self.replay];
        Running::start(
            &[
                &["learner", "--preset", "debug", "--run-dir", &run_dir],
                &addresses[..],
                settings,
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

#[test]
fn a_stop_does_not_wait_for_a_long_update_and_costs_only_what_no_checkpoint_holds() -> Result<()> {
    let run = Run::new()?;
    let _replay = run.start_replay()?;
    let _actor = run.start_actor("actor-0", "collect")?;
    let mut quick = run.start_learner()?;
    run.wait_for_updates(2)?;
    quick.signal("TERM")?;
    ensure!(quick.wait(SOON)?.success());
    let kept = checkpointed_updates(run.folder.path())?;
    ensure!(kept >= 2, "an update that ended in time was not kept");

    // Updates of many seconds, so that the signal comes in the middle of one.
    let long = [
        "--set",
        "behavior.imagination_horizon=1500",
        "--set",
        "learner.stop_secs=0.2",
    ];
    let mut slow = run.start_learner_with(&long)?;
    until("the learner trains", LATER, || {
        Ok(learner_status(&run.learner)?.filter(|status| status.phase == "training"))
    })?;
    slow.signal("TERM")?;
    let begun = std::time::Instant::now();
    ensure!(slow.wait(SOON)?.success());
    ensure!(
        begun.elapsed() < Duration::from_secs(5),
        "it waited for the update"
    );
    ensure!(
        checkpointed_updates(run.folder.path())? == kept,
        "half an update was kept"
    );
    Ok(())
}

/// Memory of a process that it shares with no other, in KiB.
fn own_kib(id: u32) -> Result<u64> {
    let status = std::fs::read_to_string(format!("/proc/{id}/status"))?;
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("RssAnon:"));
    let words = line.context("no RssAnon in the status of a process")?;
    Ok(words.trim().trim_end_matches("kB").trim().parse()?)
}

/// What Prometheus would get.
fn scraped(address: &str) -> Result<String> {
    let mut stream = std::net::TcpStream::connect(address)?;
    write!(stream, "GET /metrics HTTP/1.0\r\nHost: x\r\n\r\n")?;
    let mut text = String::new();
    stream.read_to_string(&mut text)?;
    Ok(text)
}

#[test]
fn a_stopped_learner_holds_the_actors_and_costs_no_memory() -> Result<()> {
    let run = Run::new()?;
    let replay = run.start_replay()?;
    let learner = run.start_learner()?;
    let _actor = run.start_actor("actor-0", "collect")?;
    let before = run.wait_for_updates(8)?;

    learner.signal("STOP")?;
    let held = until("inserts wait", SOON, || {
        Ok(replay_status(&run.replay)?.filter(|status| !status.insert_waiting.is_empty()))
    })?;
    ensure!(
        held.insert_waiting.contains("the learner is behind"),
        "{held:?}"
    );
    let memory = own_kib(replay.id())?;
    std::thread::sleep(Duration::from_secs(8));
    let later = until("replay answers", SOON, || replay_status(&run.replay))?;
    ensure!(
        later.inserted_steps == held.inserted_steps,
        "inserts went on: {} and {}",
        held.inserted_steps,
        later.inserted_steps
    );
    let grown = own_kib(replay.id())?.saturating_sub(memory);
    ensure!(
        grown < 4096,
        "replay grew by {grown} KiB while nobody moved"
    );
    let metrics = scraped(&run.metrics)?;
    for expected in [
        "replay_insert_waiting 1",
        "replay_sample_waiting 0",
        &format!("replay_inserted_steps_total {}", later.inserted_steps),
        "replay_commit_seconds",
    ] {
        ensure!(metrics.contains(expected), "{expected} is not in {metrics}");
    }

    learner.signal("CONT")?;
    run.wait_for_updates(before + 10)?;
    let after = until("replay answers", SOON, || replay_status(&run.replay))?;
    ensure!(
        after.inserted_steps > later.inserted_steps,
        "inserts do not go on"
    );
    Ok(())
}
