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

/// What each role is given by `deploy/`, where nobody gets all secrets.
#[test]
fn a_role_needs_no_secrets_but_its_own() -> Result<()> {
    const CLIENT: [&str; 3] = ["ca.pem", "client.pem", "client.key"];
    const SERVER: [&str; 3] = ["server.pem", "server.key", "tokens"];
    let folder = tempfile::tempdir()?;
    let path = |name: &str| folder.path().join(name).display().to_string();
    ensure!(isodream(&["secrets", &path("all")])?.status.success());
    for (role, files) in [
        ("replay", [&CLIENT[..], &SERVER].concat()),
        (
            "learner",
            [&CLIENT[..], &SERVER, &["learner.token"]].concat(),
        ),
        ("actor", [&CLIENT[..], &["actor.token"]].concat()),
    ] {
        fs::create_dir(path(role))?;
        for file in files {
            fs::copy(
                path(&format!("all/{file}")),
                path(&format!("{role}/{file}")),
            )?;
        }
    }
    let (replay, learner) = (free_address()?, free_address()?);
    let start = |role: &str, more: &[&str]| {
        let secrets = path(role);
        let usual = [role, "--preset", "debug", "--secrets", &secrets];
        Running::start(&[&usual[..], more].concat())
    };
    let (store, run) = (path("store"), path("run"));
    let _replay = start("replay", &["--dir", &store, "--listen", &replay])?;
    let addresses = ["--replay", &replay];
    let learns = ["--run-dir", &run, "--listen", &learner];
    let _learner = start("learner", &[&learns[..], &addresses].concat())?;
    let acts = ["--id", "actor-0", "--learner", &learner];
    let _actor = start("actor", &[&acts[..], &addresses].concat())?;
    until("the learner learns", LATER, || {
        let metrics = fs::read_to_string(folder.path().join("run/metrics.jsonl"));
        Ok(metrics
            .is_ok_and(|metrics| metrics.contains("train/updates"))
            .then_some(()))
    })
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
