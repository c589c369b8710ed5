//! `isodream replay inspect` and `verify` on the store of a real run.

use std::fs;

use anyhow::{Context, Result, ensure};
use isodream_tests::isodream;
use serde_json::Value;

fn json(args: &[&str]) -> Result<Value> {
    let output = isodream(args)?;
    ensure!(
        output.status.success(),
        "{args:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    Ok(serde_json::from_slice(&output.stdout)?)
}

#[test]
fn a_store_is_inspected_verified_and_found_damaged() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let run_dir = folder.path().join("run").display().to_string();
    let settings = ["--preset", "debug", "--set", "learner.env_frames=800"];
    let trained = isodream(
        &[
            &["train", "--run-dir", &run_dir, "--eval-episodes", "0"][..],
            &settings,
        ]
        .concat(),
    )?;
    ensure!(trained.status.success(), "{trained:?}");
    let store = format!("{run_dir}/replay");
    let frame = folder.path().join("frame.png");
    let path = frame.display().to_string();
    let found = json(&["replay", "inspect", &store, "--frame", &path, "--json"])?;
    ensure!(fs::read(&frame)?.starts_with(b"\x89PNG"));
    let inserted = found["inserted_steps"].as_u64().context("steps")?;
    ensure!(inserted >= 200, "{found}");
    ensure!(
        found["episodes"]["count"].as_u64() > Some(1)
            && found["actors"][0]["actor_id"] == "actor-0",
        "{found}"
    );
    let sound = json(&["replay", "verify", &store, "--json"])?;
    ensure!(sound["damage"] == Value::Array(Vec::new()), "{sound}");

    let segment = found["segments"][0]["path"].as_str().context("path")?;
    let mut bytes = fs::read(segment)?;
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(segment, bytes)?;
    let verified = isodream(&["replay", "verify", &store])?;
    let said = String::from_utf8(verified.stderr)?;
    ensure!(
        !verified.status.success() && said.contains("1 damaged"),
        "{said}"
    );
    Ok(())
}
