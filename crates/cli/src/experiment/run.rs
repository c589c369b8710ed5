//! Training and evaluating, run after run.

use std::collections::VecDeque;
use std::fs::File;
use std::path::Path;
use std::process::Stdio;
use std::time::Instant;

use anyhow::{Context, bail, ensure};
use isodream_rpc::shutdown_on_signal;
use rustix::process::{Pid, Signal, kill_process};
use tokio::process::Command;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use super::RunArgs;
use super::plan::{Plan, Run};

/// Makes all runs that were not made before.
pub(super) async fn run(args: &RunArgs) -> anyhow::Result<()> {
    let (name, definition) = args.choice.definition()?;
    let known: Vec<&str> = definition
        .methods
        .iter()
        .map(|method| &*method.name)
        .collect();
    check("--methods", &args.methods, &known)?;
    let known: Vec<&str> = definition.tasks.iter().map(|task| &*task.name).collect();
    check("--tasks", &args.tasks, &known)?;
    let most = definition.size(args.choice.scale)?.seeds;
    if let Some(seeds) = args.seeds {
        ensure!(
            (1..=most).contains(&seeds),
            "--seeds {seeds}: this experiment has 1 to {most} at this scale; more are a line `seeds` in a file of one's own"
        );
    }
    let folder = args.choice.out.join(&name).join(args.choice.scale.as_str());
    let plan = Plan::new(&definition, args.choice.scale, &folder)?;
    let wanted = |run: &Run| {
        args.seeds.is_none_or(|seeds| run.seed < seeds)
            && (args.methods.is_empty() || args.methods.contains(&run.method))
            && (args.tasks.is_empty() || args.tasks.contains(&run.task))
    };
    let mut waiting: VecDeque<Run> = plan.runs.into_iter().filter(wanted).collect();
    let count = waiting.len();
    let shutdown = shutdown_on_signal()?;
    let (mut working, mut failed) = (JoinSet::new(), Vec::new());
    loop {
        while working.len() < usize::from(args.parallel) && !shutdown.is_cancelled() {
            let next = waiting.iter().position(Run::can_begin);
            let Some(run) = next.and_then(|next| waiting.remove(next)) else {
                break;
            };
            let stop = shutdown.clone();
            working.spawn(async move { (run.name(), complete(&run, &stop).await) });
        }
        let Some(ended) = working.join_next().await else {
            break;
        };
        let (name, result) = ended.context("a run's task died")?;
        let done = count - waiting.len() - working.len();
        match result {
            Ok(words) => eprintln!("{done} of {count}: {name}: {words}"),
            Err(error) => {
                eprintln!("{done} of {count}: {name}: {error:#}");
                failed.push(name);
            }
        }
    }
    ensure!(
        !shutdown.is_cancelled(),
        "interrupted; the same command goes on from here"
    );
    failed.extend(waiting.iter().map(Run::name));
    ensure!(
        failed.is_empty(),
        "{} of {count} runs failed, or have no source to begin with: {}; the same command tries them again",
        failed.len(),
        failed.join(", ")
    );
    Ok(())
}

fn check(option: &str, asked: &[String], known: &[&str]) -> anyhow::Result<()> {
    match asked.iter().find(|name| !known.contains(&&***name)) {
        Some(name) => bail!("{option} {name}: known are {}", known.join(", ")),
        None => Ok(()),
    }
}

/// Trains and evaluates what of a run is missing.
async fn complete(run: &Run, stop: &CancellationToken) -> anyhow::Result<String> {
    let begun = Instant::now();
    std::fs::create_dir_all(&run.dir)
        .with_context(|| format!("cannot create {}", run.dir.display()))?;
    let dir = run.dir.display().to_string();
    let episodes = run.episodes.to_string();
    let mut made = false;
    if !run.is_made()? {
        let mut args = vec!["train", "--preset", &run.preset, "--run-dir", &dir];
        args.extend(["--eval-episodes", &episodes, "--dashboard-listen", "off"]);
        args.extend(settings(&run.set));
        child(&args, &run.dir.join("train.log"), None, stop).await?;
        ensure!(run.evaluation().exists(), "stopped before its end");
        made = true;
    }
    for test in &run.tests {
        let path = run.test(test);
        if !path.exists() {
            let mut args = vec![
                "eval",
                "--checkpoint",
                &dir,
                "--episodes",
                &episodes,
                "--json",
            ];
            args.extend(settings(&test.set));
            child(&args, &run.dir.join("test.log"), Some(&path), stop).await?;
            made = true;
        }
    }
    Ok(match made {
        true => format!("done in {:.0} s", begun.elapsed().as_secs_f64()),
        false => "was made before".to_owned(),
    })
}

fn settings(set: &[String]) -> impl Iterator<Item = &str> {
    set.iter().flat_map(|setting| ["--set", &**setting])
}

/// Runs this program with `args` to its end; what it prints goes to `output`, under that name only when it is whole.
async fn child(
    args: &[&str],
    log: &Path,
    output: Option<&Path>,
    stop: &CancellationToken,
) -> anyhow::Result<()> {
    let failed = |path: &Path| format!("cannot write {}", path.display());
    let part = output.map(|path| path.with_extension("part"));
    let stdout = match &part {
        Some(part) => File::create(part).with_context(|| failed(part))?.into(),
        None => Stdio::null(),
    };
    // What an earlier attempt died of stays.
    let stderr = File::options()
        .create(true)
        .append(true)
        .open(log)
        .with_context(|| failed(log))?;
    let program = std::env::current_exe().context("this program has no path")?;
    let mut child = Command::new(program)
        .args(args)
        .stdin(Stdio::null())
        .stdout(stdout)
        .stderr(stderr)
        .kill_on_drop(true)
        .spawn()
        .context("cannot start a run")?;
    let ended = tokio::select! {
        ended = child.wait() => ended,
        () = stop.cancelled() => {
            // A terminal's Ctrl-C reached it already; it takes a second one as the first.
            let pid = child.id().and_then(|id| Pid::from_raw(id.cast_signed()));
            if let Some(pid) = pid {
                let _ = kill_process(pid, Signal::INT);
            }
            child.wait().await
        }
    };
    let status = ended.context("cannot watch a run")?;
    ensure!(
        status.success(),
        "it ended with {status}; see {}",
        log.display()
    );
    if let (Some(part), Some(output)) = (part, output) {
        std::fs::rename(&part, output)
            .with_context(|| format!("cannot write {}", output.display()))?;
    }
    Ok(())
}
