//! `isodream train` as a person uses it: interrupted, resumed, killed, and evaluated.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use isodream_learner::checkpoint::Checkpoint;
use isodream_tests::{Running, alive, free_address, isodream, learner_status, until};

const LATER: Duration = Duration::from_secs(240);

#[test]
fn an_interrupted_run_stops_in_ten_seconds_and_resumes_to_its_end() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let run_dir = folder.path().join("run").display().to_string();
    let learner = free_address()?;
    let shrink = ["--set", "learner.env_frames=2400"];
    let args = [
        &[
            "train",
            "--preset",
            "debug",
            "--run-dir",
            &run_dir,
            "--learner-listen",
            &learner,
            "--eval-episodes",
            "1",
        ],
        &shrink[..],
    ]
    .concat();

    let mut train = Running::start(&args)?;
    until("some updates are made", LATER, || {
        Ok(learner_status(&learner)?.filter(|status| status.updates >= 8))
    })?;
    let children = train.children()?;
    ensure!(
        children.len() == 5,
        "replay, learner, two actors and an evaluator: {children:?}"
    );
    let interrupted = Instant::now();
    train.signal("INT")?;
    ensure!(
        train.wait(Duration::from_secs(15))?.success(),
        "an interrupted run ends well"
    );
    ensure!(
        interrupted.elapsed() < Duration::from_secs(10),
        "it took {:?}",
        interrupted.elapsed()
    );
    ensure!(
        !children.iter().any(|&child| alive(child)),
        "roles were left behind"
    );
    let stopped_at = Checkpoint::find(run_dir.as_ref())?.counters.updates;
    ensure!(
        stopped_at >= 8,
        "the checkpoint has only {stopped_at} updates"
    );

    let mut train = Running::start(&args)?;
    ensure!(train.wait(LATER)?.success(), "the resumed run ends well");
    let finished = Checkpoint::find(run_dir.as_ref())?;
    ensure!(finished.counters.updates == finished.config.total_updates());
    ensure!(
        finished.counters.updates > stopped_at,
        "more updates than before"
    );

    let output = isodream(&[
        "eval",
        "--checkpoint",
        &run_dir,
        "--episodes",
        "1",
        "--json",
    ])?;
    let evaluation: serde_json::Value =
        serde_json::from_slice(&output.stdout).context("eval prints JSON")?;
    for policy in ["trained", "random", "keep_lane", "overtake"] {
        for field in [
            "return_mean",
            "return_std",
            "collisions_mean",
            "distance_m_mean",
        ] {
            ensure!(
                evaluation["policies"][policy][field].is_f64(),
                "no {policy}.{field} in {evaluation}"
            );
        }
    }
    Ok(())
}

#[test]
fn a_killed_supervisor_leaves_no_orphans() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let run_dir = folder.path().join("run").display().to_string();
    let learner = free_address()?;
    let train = Running::start(&[
        "train",
        "--preset",
        "debug",
        "--run-dir",
        &run_dir,
        "--learner-listen",
        &learner,
    ])?;
    until("the learner is up", LATER, || learner_status(&learner))?;
    let children = train.children()?;
    ensure!(!children.is_empty());
    train.kill()?;
    until("all roles are gone", Duration::from_secs(20), || {
        Ok((!children.iter().any(|&child| alive(child))).then_some(()))
    })
}
