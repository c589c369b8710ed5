//! Every mistake a person can make ends with one line that names the thing and the cure.

use std::net::TcpListener;

use anyhow::{Result, ensure};
use isodream_tests::isodream;

/// Runs `isodream` and returns its one error line.
fn error_of(args: &[&str]) -> Result<String> {
    let output = isodream(args)?;
    let text = String::from_utf8(output.stderr)?;
    ensure!(
        !output.status.success(),
        "{args:?} should fail, said {text}"
    );
    let errors: Vec<&str> = text
        .lines()
        .filter_map(|line| line.strip_prefix("error: "))
        .collect();
    ensure!(
        errors.len() == 1,
        "{args:?} should fail with one line, said {text}"
    );
    Ok(errors[0].to_owned())
}

fn assert_names(args: &[&str], parts: &[&str]) -> Result<()> {
    let error = error_of(args)?;
    for part in parts {
        ensure!(
            error.contains(part),
            "{args:?}: `{part}` is missing in: {error}"
        );
    }
    Ok(())
}

#[test]
fn wrong_configurations_are_named() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let run_dir = folder.path().join("run").display().to_string();
    let train = |more: &[&'static str]| -> Vec<String> {
        let all = [&["train", "--run-dir"], &[run_dir.as_str()][..], more].concat();
        all.into_iter().map(str::to_owned).collect()
    };
    for (more, parts) in [
        (vec!["--preset", "quik"], vec!["quik", "quick"]),
        (
            vec!["--set", "learner.batchsize=3"],
            vec!["learner.batchsize", "learner.batch_size"],
        ),
        (
            vec!["--set", "learner.batch_size=many"],
            vec!["learner.batch_size", "integer"],
        ),
        (
            vec!["--set", "learner.replay_ratio=0"],
            vec!["learner.replay_ratio", "greater than 0"],
        ),
        (
            vec!["--set", "env.id=highway/dusk"],
            vec!["highway/dusk", "highway/day"],
        ),
        (vec!["--config", "no-such.toml"], vec!["no-such.toml"]),
    ] {
        let args = train(&more);
        assert_names(&args.iter().map(String::as_str).collect::<Vec<_>>(), &parts)?;
        ensure!(
            !folder.path().join("run").exists(),
            "{more:?} left a run directory behind"
        );
    }
    Ok(())
}

#[test]
fn a_port_in_use_is_named_and_nothing_is_left_behind() -> Result<()> {
    let taken = TcpListener::bind("127.0.0.1:0")?;
    let address = taken.local_addr()?.to_string();
    let folder = tempfile::tempdir()?;
    let dir = folder.path().join("replay").display().to_string();
    let run_dir = folder.path().join("run").display().to_string();
    let cure = [address.as_str(), "another port"];
    assert_names(
        &[
            "replay", "--preset", "debug", "--dir", &dir, "--listen", &address,
        ],
        &cure,
    )?;
    assert_names(
        &[
            "learner",
            "--preset",
            "debug",
            "--run-dir",
            &run_dir,
            "--listen",
            &address,
        ],
        &cure,
    )?;
    assert_names(
        &[
            "train",
            "--preset",
            "debug",
            "--run-dir",
            &run_dir,
            "--learner-listen",
            &address,
        ],
        &cure,
    )
}

#[test]
fn a_missing_checkpoint_is_named() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().display().to_string();
    assert_names(
        &["eval", "--checkpoint", &path],
        &["no checkpoint in", &path],
    )?;
    assert_names(
        &["imagine", "--checkpoint", &path],
        &["no checkpoint in", &path],
    )
}

#[test]
fn a_run_directory_of_another_environment_is_refused() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let run_dir = folder.path().display().to_string();
    std::fs::write(
        folder.path().join("config.toml"),
        "[env]\nid = \"highway/night\"\n",
    )?;
    assert_names(
        &["train", "--preset", "debug", "--run-dir", &run_dir],
        &["--run-dir", &run_dir],
    )
}

#[test]
fn the_doctor_names_what_a_run_would_miss_and_the_cure() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let here = folder.path().display().to_string();
    let output = isodream(&["doctor", "--dir", &here])?;
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    ensure!(output.status.success(), "{said}");
    for thing in [
        "processor",
        "memory",
        "disk",
        "libtorch",
        "highway",
        "MuJoCo",
    ] {
        ensure!(said.contains(&format!("  {thing}")), "no {thing}: {said}");
    }
    ensure!(!said.contains("BAD"), "{said}");
    ensure!(
        std::fs::read_dir(folder.path())?.count() == 0,
        "the doctor left something behind"
    );

    let nowhere = folder.path().join("nowhere").display().to_string();
    let output = isodream(&["doctor", "--dir", &nowhere])?;
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    ensure!(!output.status.success(), "{said}");
    ensure!(said.contains("BAD   disk"), "{said}");
    ensure!(said.contains("give a folder that exists: --dir"), "{said}");
    Ok(())
}
