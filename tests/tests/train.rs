//! `isodream train` as a person uses it: interrupted, resumed, killed, and evaluated.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use isodream_learner::checkpoint::Checkpoint;
use isodream_telemetry::media::{EpisodeFacts, OpenLoopFacts};
use isodream_telemetry::probe::ProbeReport;
use isodream_tests::{Running, alive, free_address, isodream, learner_status, until};

const LATER: Duration = Duration::from_secs(240);

#[test]
fn an_interrupted_run_stops_in_ten_seconds_and_resumes_to_its_end() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let run_dir = folder.path().join("run").display().to_string();
    let (learner, page) = (free_address()?, free_address()?);
    let shrink = [
        "--set",
        "learner.env_frames=2400",
        "--set",
        "actor.probe_states=2",
    ];
    let args = [
        &[
            "train",
            "--preset",
            "debug",
            "--run-dir",
            &run_dir,
            "--learner-listen",
            &learner,
            "--dashboard-listen",
            &page,
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
    let live = get(&page, "/api/live")?;
    ensure!(
        live.contains("\"up\":true") && live.contains("\"id\":\"actor-0\""),
        "the page does not know the run: {live}"
    );
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
    check_shown(run_dir.as_ref())?;
    ensure!(
        finished.counters.updates > stopped_at,
        "more updates than before"
    );

    let stranger = [
        "learner",
        "--preset",
        "debug",
        "--set",
        "model.deter=24",
        "--run-dir",
        &run_dir,
        "--replay",
        "127.0.0.1:1",
        "--listen",
        "127.0.0.1:0",
    ];
    changes_nothing(&stranger, "choose another --run-dir", run_dir.as_ref())?;

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
    for policy in ["trained", "random", "keep_lane", "reacting"] {
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
    check_counterfactual(&run_dir, folder.path())
}

/// The world model can be probed, and its scores are numbers.
fn check_counterfactual(run_dir: &str, folder: &Path) -> Result<()> {
    let out = folder.join("counterfactual");
    let output = isodream(&[
        "imagine",
        "--counterfactual",
        "--checkpoint",
        run_dir,
        "--episodes",
        "1",
        "--states",
        "1",
        "--json",
        "--out",
        &out.display().to_string(),
    ])?;
    let report: ProbeReport = serde_json::from_slice(&output.stdout).with_context(|| {
        let words = String::from_utf8_lossy(&output.stderr);
        format!("imagine --counterfactual prints no JSON: {words}")
    })?;
    ensure!(report.horizon == 15 && report.plans.len() == 6 && !report.kinds.is_empty());
    for scores in report.kinds.values().chain([&report.all]) {
        let measured = [scores.bias, scores.rmse];
        let returns = scores.real.iter().chain(&scores.imagined);
        ensure!(scores.states > 0 && scores.real.len() == 6, "{scores:?}");
        ensure!(
            measured
                .iter()
                .chain(returns)
                .all(|value| value.is_finite())
        );
        let rank = scores.rank_correlation.context("pedals have no order")?;
        ensure!((-1.0..=1.0).contains(&rank), "{scores:?}");
    }
    let kept = std::fs::read(out.join("counterfactual.json"))?;
    ensure!(serde_json::from_slice::<ProbeReport>(&kept)? == report);
    ensure!(std::fs::read(out.join("counterfactual.png"))?.starts_with(b"\x89PNG"));
    Ok(())
}

/// Fails unless a command is refused with `words` and leaves the configuration of the run as it is.
fn changes_nothing(args: &[&str], words: &str, run_dir: &Path) -> Result<()> {
    let config = run_dir.join("config.toml");
    let before = std::fs::read_to_string(&config)?;
    let output = isodream(args)?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(!output.status.success() && said.contains(words), "{said}");
    ensure!(
        std::fs::read_to_string(&config)? == before,
        "{args:?} changed the run's configuration"
    );
    Ok(())
}

/// The body of what the page's server answers.
fn get(address: &str, path: &str) -> Result<String> {
    let mut stream = TcpStream::connect(address)?;
    write!(stream, "GET {path} HTTP/1.0\r\nHost: {address}\r\n\r\n")?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer)?;
    let (_, body) = answer.split_once("\r\n\r\n").context("no answer")?;
    Ok(body.to_owned())
}

/// A run shows its evaluations and what its world model predicts.
fn check_shown(run_dir: &Path) -> Result<()> {
    let names: Vec<String> = std::fs::read_dir(run_dir.join("media"))?
        .map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()))
        .collect::<Result<_>>()?;
    let newest = |kind: &str| {
        let described = |name: &&String| name.starts_with(kind) && name.ends_with(".json");
        let newest = names.iter().filter(described).max();
        newest.with_context(|| format!("no {kind} among {names:?}"))
    };
    let read = |name: &str| std::fs::read(run_dir.join("media").join(name));
    let episode: EpisodeFacts = serde_json::from_slice(&read(newest("episode")?)?)?;
    ensure!(episode.attention.len() == episode.length as usize);
    ensure!(episode.gate.len() == episode.length as usize);
    for weights in &episode.attention {
        let sum: f32 = weights.iter().sum();
        ensure!((sum - 1.0).abs() < 1e-4, "{weights:?} sum to {sum}");
    }
    let panel: OpenLoopFacts = serde_json::from_slice(&read(newest("open_loop")?)?)?;
    ensure!(panel.error.len() == 8 && panel.error.iter().all(|error| *error > 0.0));
    for name in [newest("episode")?, newest("open_loop")?] {
        let video = read(&name.replace(".json", ".mp4"))?;
        ensure!(video[4..8] == *b"ftyp", "{name} has no video");
    }
    let table = std::fs::read_to_string(run_dir.join("evaluations.csv"))?;
    let columns = table.lines().next().context("evaluations.csv is empty")?;
    ensure!(columns.starts_with("frames,updates,episode_id,score,length,end_reason,"));
    ensure!(table.lines().count() > 1, "no evaluation in {table}");
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
    // Roles that are restarted read it again.
    let train_too = ["train", "--run-dir", &run_dir];
    let second = [&train_too[..], &["--preset", "debug", "--set", "seed=5"]].concat();
    changes_nothing(&second, "is in use by another train", run_dir.as_ref())?;
    let children = train.children()?;
    ensure!(!children.is_empty());
    train.kill()?;
    until("all roles are gone", Duration::from_secs(20), || {
        Ok((!children.iter().any(|&child| alive(child))).then_some(()))
    })
}

#[test]
fn a_run_whose_time_is_up_before_its_first_update_ends_well() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let run_dir = folder.path().join("run").display().to_string();
    let train = ["train", "--preset", "debug", "--run-dir", &run_dir];
    let output = isodream(&[&train[..], &["--minutes", "0.0001"]].concat())?;
    let words = String::from_utf8_lossy(&output.stderr);
    ensure!(
        output.status.success() && words.contains("nothing was trained yet"),
        "{words}"
    );
    Ok(())
}
