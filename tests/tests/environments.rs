//! `isodream env` as a person uses it, and DeepMind Control from its models to a trained checkpoint.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Result, ensure};
use isodream_learner::checkpoint::Checkpoint;
use isodream_tests::{Running, binary, free_address, isodream, replay_status, until};
use serde_json::Value;

/// What `isodream` with `args` prints; its failure is an error with its own words.
fn printed(args: &[&str]) -> Result<String> {
    let output = isodream(args)?;
    let words = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "{args:?}: {words}");
    Ok(String::from_utf8(output.stdout)?)
}

/// Why `isodream` with `args` fails.
fn refused(args: &[&str]) -> Result<String> {
    let output = isodream(args)?;
    ensure!(!output.status.success(), "{args:?} was taken");
    Ok(String::from_utf8(output.stderr)?)
}

#[test]
fn environments_are_listed_played_and_measured() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let specs: Vec<Value> = serde_json::from_str(&printed(&["env", "list", "--json"])?)?;
    for id in ["highway/straight/night", "dmc/cheetah_run/video_hard"] {
        ensure!(specs.iter().any(|spec| spec["id"] == id), "{id} is missing");
    }

    let starts: [(&str, &[u8]); 3] = [
        ("a.gif", b"GIF89a"),
        ("a.png", b"\x89PNG"),
        ("a.mp4", b"\0\0\0"),
    ];
    for (name, start) in starts {
        let path = folder.path().join(name).display().to_string();
        let id = "dmc/pendulum_swingup/video_easy";
        let said = printed(&["env", "play", id, "--out", &path, "--steps", "5"])?;
        ensure!(said.contains("in 5 steps"), "{said}");
        ensure!(fs::read(&path)?.starts_with(start), "{name}");
    }

    let args = ["env", "bench", "highway/day", "--seconds", "0.05", "--json"];
    let rates: Value = serde_json::from_str(&printed(&args)?)?;
    ensure!(rates[0]["id"] == "highway/day" && rates[0]["peer_frames_per_s"].is_null());
    for field in ["frames_per_s", "steps_per_s", "vector_speedup"] {
        ensure!(rates[0][field].as_f64() > Some(0.0), "{rates}");
    }
    Ok(())
}

#[test]
fn what_cannot_be_played_is_said() -> Result<()> {
    let to = |id, out, policy| ["env", "play", id, "--out", out, "--policy", policy];
    let error = refused(&to("dmc/walker_wlak", "a.png", "random"))?;
    ensure!(error.contains("dmc/walker_walk"), "{error}");
    let error = refused(&to("highway/day", "a.jpg", "random"))?;
    ensure!(error.contains(".mp4"), "{error}");
    let error = refused(&to("highway/day", "a.png", "careful"))?;
    ensure!(error.contains("keep_lane"), "{error}");
    let error = refused(&to("dmc/walker_walk", "a.png", "reacting"))?;
    ensure!(error.contains("privileged"), "{error}");
    Ok(())
}

#[test]
fn without_mujoco_the_rest_works() -> Result<()> {
    let folder = tempfile::tempdir()?;
    // Away from where the binary finds its libraries.
    let moved = folder.path().join("isodream");
    fs::copy(binary()?, &moved)?;
    let libtorch = Path::new(env!("CARGO_MANIFEST_DIR")).join("../.native/libtorch/lib");
    let play = |id: &str| -> Result<(bool, String)> {
        let output = Command::new(&moved)
            .env("LD_LIBRARY_PATH", &libtorch)
            .args(["env", "play", id, "--steps", "3", "--out"])
            .arg(folder.path().join("a.png"))
            .output()?;
        let said = String::from_utf8(output.stderr)?;
        Ok((output.status.success(), said))
    };
    let (worked, said) = play("highway/day")?;
    ensure!(worked, "{said}");
    let (worked, said) = play("dmc/walker_walk")?;
    ensure!(
        !worked && said.contains("cargo xtask setup") && said.contains("libmujoco"),
        "{said}"
    );
    Ok(())
}

#[test]
fn an_environment_of_another_process_is_played() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let address = free_address()?;
    let served = Running::start(&["env", "serve", "dmc/finger_spin", "--listen", &address])?;
    let remote = format!("grpc://{address}");
    let file = |name: &str| folder.path().join(name).display().to_string();
    let (here, there) = (file("here.png"), file("there.png"));
    until("it serves", Duration::from_secs(30), || {
        let output = isodream(&["env", "play", &remote, "--out", &there, "--steps", "6"])?;
        Ok(output.status.success().then_some(()))
    })?;
    printed(&[
        "env",
        "play",
        "dmc/finger_spin",
        "--out",
        &here,
        "--steps",
        "6",
    ])?;
    ensure!(fs::read(&here)? == fs::read(&there)?, "other pictures");
    served.kill()?;
    let error = refused(&["env", "play", &remote, "--out", &there])?;
    ensure!(
        error.contains(&address) && error.contains("connection lost"),
        "{error}"
    );
    Ok(())
}

#[test]
fn control_is_trained_on() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let run_dir = folder.path().join("run").display().to_string();
    let said = printed(&[
        "train",
        "--preset",
        "debug",
        "--run-dir",
        &run_dir,
        "--eval-episodes",
        "1",
        "--set",
        "env.id=dmc/ball_in_cup_catch/video_easy",
        "--set",
        "model.indicator=false",
        "--set",
        "learner.env_frames=1600",
    ])?;
    ensure!(
        said.contains("trained") && said.contains("random"),
        "{said}"
    );
    ensure!(
        !said.contains("keep_lane"),
        "nobody can drive a cup: {said}"
    );
    ensure!(Checkpoint::find(run_dir.as_ref())?.counters.updates > 0);
    Ok(())
}

#[test]
fn training_goes_on_when_the_environments_process_dies_and_comes_back() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let (address, replay) = (free_address()?, free_address()?);
    // Two collectors and the evaluator take all three.
    let serve = [
        "env",
        "serve",
        "highway/day",
        "--environments",
        "3",
        "--set",
        "env.vehicles=5",
        "--listen",
        &address,
    ];
    let served = Running::start(&serve)?;
    let remote = format!("env.id=grpc://{address}");
    let run_dir = folder.path().join("run").display().to_string();
    let train = [
        "train",
        "--preset",
        "debug",
        "--run-dir",
        &run_dir,
        "--eval-episodes",
        "1",
        "--replay-listen",
        &replay,
        "--set",
        &remote,
        "--set",
        "learner.env_frames=2400",
    ];
    until("it serves", Duration::from_secs(30), || {
        let args = [
            "env",
            "bench",
            &format!("grpc://{address}"),
            "--seconds",
            "0.01",
        ];
        Ok(isodream(&args)?.status.success().then_some(()))
    })?;
    let mut training = Running::start(&train)?;
    let inserted = |steps: u64| {
        until("steps arrive", Duration::from_secs(120), || {
            let status = replay_status(&replay)?;
            Ok(status
                .map(|status| status.inserted_steps)
                .filter(|&inserted| inserted >= steps))
        })
    };
    let before = inserted(60)?;
    served.kill()?;
    std::thread::sleep(Duration::from_secs(1));
    let _served = Running::start(&serve)?;
    inserted(before + 100)?;
    let status = training.wait(Duration::from_secs(300))?;
    ensure!(status.success(), "{status}");
    ensure!(Checkpoint::find(run_dir.as_ref())?.counters.updates > 0);
    let log = |actor| fs::read_to_string(folder.path().join(format!("run/logs/{actor}.log")));
    let logs = [log("actor-0")?, log("actor-1")?];
    // One of them may not have begun when the server died: it waits for it instead.
    ensure!(
        logs.iter().any(|log| log.contains("a new episode begins")),
        "{logs:?}"
    );
    for log in &logs {
        ensure!(
            log.matches("acting by the learner's policy").count() <= 1,
            "an actor was started anew: {log}"
        );
    }
    Ok(())
}
