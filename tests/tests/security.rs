//! A run whose roles ask each other for certificates and tokens.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::process::Output;
use std::time::Duration;

use anyhow::{Result, ensure};
use isodream_tests::{Running, free_address, isodream, until};

const SOON: Duration = Duration::from_secs(60);
const LATER: Duration = Duration::from_secs(240);

fn words(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn a_run_behind_certificates_and_tokens_trains_and_strangers_stay_outside() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let path = |name: &str| folder.path().join(name).display().to_string();
    let secrets = path("secrets");
    ensure!(isodream(&["secrets", &secrets])?.status.success());
    for entry in fs::read_dir(&secrets)? {
        let mode = entry?.metadata()?.permissions().mode();
        ensure!(mode & 0o077 == 0, "others may read a secret: {mode:o}");
    }
    let again = isodream(&["secrets", &secrets])?;
    ensure!(
        words(&again).contains("holds secrets already"),
        "{}",
        words(&again)
    );

    let (replay, learner, run_dir) = (free_address()?, free_address()?, path("run"));
    let train = [
        &["train", "--preset", "debug", "--eval-episodes", "0"][..],
        &["--run-dir", &run_dir, "--secrets", &secrets],
        &["--replay-listen", &replay, "--learner-listen", &learner],
    ];
    let mut running = Running::start(&train.concat())?;
    let health = |more: &[&str]| isodream(&[&["health", &replay], more].concat());
    until("the replay-server serves", SOON, || {
        Ok(health(&["--secrets", &secrets])?
            .status
            .success()
            .then_some(()))
    })?;
    let stranger = health(&["--timeout", "5"])?;
    ensure!(!stranger.status.success(), "a stranger was let in");
    let token = path("secrets/viewer.token");
    let viewer = [
        &[
            "actor",
            "--preset",
            "debug",
            "--id",
            "viewer",
            "--token-file",
            &token,
        ][..],
        &[
            "--secrets",
            &secrets,
            "--replay",
            &replay,
            "--learner",
            &learner,
        ],
    ];
    let viewer = isodream(&viewer.concat())?;
    ensure!(
        viewer.status.code() == Some(1) && words(&viewer).contains("the token's role is viewer"),
        "{}",
        words(&viewer)
    );

    ensure!(running.wait(LATER)?.success(), "the run ends well");
    let metrics = fs::read_to_string(folder.path().join("run/metrics.jsonl"))?;
    ensure!(
        metrics.contains("episode/score"),
        "actors collected nothing"
    );
    for role in ["actor", "learner", "viewer"] {
        let token = fs::read_to_string(path(&format!("secrets/{role}.token")))?;
        for log in fs::read_dir(folder.path().join("run/logs"))? {
            let text = fs::read_to_string(log?.path())?;
            ensure!(
                !text.contains(token.trim()),
                "the {role}'s token is in a log"
            );
        }
    }
    Ok(())
}

#[test]
fn what_would_be_open_to_all_does_not_start() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let dir = folder.path().join("replay").display().to_string();
    let replay = [
        "replay",
        "--preset",
        "debug",
        "--dir",
        &dir,
        "--listen",
        "0.0.0.0:0",
    ];
    let refused = isodream(&replay)?;
    ensure!(
        !refused.status.success() && words(&refused).contains("nothing guards it"),
        "{}",
        words(&refused)
    );
    ensure!(
        !folder.path().join("replay").exists(),
        "nothing is made before that"
    );
    Ok(())
}
