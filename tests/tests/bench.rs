//! What the benchmarks print can be read by scripts.

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

fn positive(result: &Value, field: &str) -> Result<f64> {
    let value = result[field]
        .as_f64()
        .with_context(|| format!("no number `{field}` in {result}"))?;
    ensure!(value > 0.0, "{field} is {value}");
    Ok(value)
}

#[test]
fn the_learner_benchmark_accounts_for_its_time() -> Result<()> {
    let result = json(&[
        "bench", "learner", "--preset", "debug", "--batch", "2", "--length", "6", "--steps", "1",
        "--json",
    ])?;
    ensure!(result["dtype"] == "fp32" && result["batch"] == 2 && result["length"] == 6);
    for field in [
        "cpu_seconds_per_step",
        "flops_per_step",
        "gemm_gflops_fp32",
        "gemm_gflops_bf16",
        "peak_rss_bytes",
    ] {
        positive(&result, field)?;
    }
    let wall = positive(&result, "wall_seconds_per_step")?;
    let phases = result["phases"].as_array().context("no phases")?;
    let mut sum = 0.0;
    for phase in phases {
        sum += positive(phase, "wall_seconds")?;
    }
    ensure!(
        (sum - wall).abs() < 1e-6 * wall,
        "phases take {sum} of {wall}"
    );
    Ok(())
}

#[test]
fn the_actor_benchmark_measures_every_number_of_environments() -> Result<()> {
    let results = json(&[
        "bench",
        "actor",
        "--preset",
        "debug",
        "--environments",
        "1,3",
        "--steps",
        "2",
        "--json",
    ])?;
    let results = results.as_array().context("a list")?;
    let environments: Vec<_> = results
        .iter()
        .map(|result| &result["environments"])
        .collect();
    ensure!(environments == [1, 3]);
    for result in results {
        positive(result, "latency_seconds")?;
        positive(result, "environment_steps_per_cpu_second")?;
    }
    Ok(())
}

#[test]
fn the_load_generator_finds_every_actor_served() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let dir = folder.path().join("load");
    let dir = dir.to_str().context("a folder with a strange name")?;
    let result = json(&[
        "bench",
        "load",
        "--preset",
        "debug",
        "--actors",
        "4",
        "--servers",
        "2",
        "--relay",
        "--learners",
        "1",
        "--seconds",
        "4",
        "--steps-per-second",
        "100",
        "--publish-seconds",
        "1",
        "--policy-bytes",
        "100000",
        "--dir",
        dir,
        "--json",
    ])?;
    ensure!(result["actors"] == 4 && result["replay_servers"] == 2);
    for field in [
        "appended_steps_per_s",
        "appended_mb_per_s",
        "join_seconds",
        "sampled_steps_per_s",
        "policy_mb_per_s",
    ] {
        positive(&result, field)?;
    }
    positive(&result["append"], "p99_ms")?;
    positive(&result["commits"], "per_s")?;
    let complete = positive(&result["fan_out"], "complete")?;
    let verified = positive(&result["fan_out"]["actors"], "count")?;
    ensure!(verified >= 4.0 * complete, "{}", result["fan_out"]);
    ensure!(result["lost_reports"] == 0, "{}", result["lost_reports"]);
    let processes = result["processes"].as_array().context("no processes")?;
    let names: Vec<_> = processes.iter().map(|process| &process["name"]).collect();
    ensure!(
        names == ["actors", "door", "replay-0", "replay-1"],
        "{names:?}"
    );
    ensure!(
        !std::path::Path::new(dir).exists(),
        "the experience is left behind"
    );
    Ok(())
}
