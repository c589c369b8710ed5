//! `isodream train`: all roles on this machine, supervised, with live progress.
//!
//! Nothing here trains: it starts the roles as processes with loopback addresses, restarts those that die, shows
//! what they say of themselves, and evaluates the result.

mod processes;
mod progress;

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use clap::Args;
use isodream_core::Config;
use isodream_core::config::EnvConfig;
use isodream_dashboard::Sources;
use isodream_envs::{EnvError, make};
use isodream_learner::checkpoint::Checkpoint;
use isodream_rpc::{Dialer, Door, Role, environment_spec, remote_address, shutdown_on_signal};
use isodream_telemetry::write_whole;
use tokio_util::task::AbortOnDropHandle;

use crate::config_args::ConfigArgs;
use crate::dashboard::PageArgs;
use crate::eval::evaluate;
use crate::output::print;
use crate::security::DoorArgs;
use processes::{Process, Processes};
use progress::Progress;

/// How often processes are looked after and the display is renewed.
const TICK: Duration = Duration::from_millis(250);

/// Options of `isodream train`.
#[derive(Debug, Args)]
pub(crate) struct TrainArgs {
    #[command(flatten)]
    config: ConfigArgs,
    /// Where everything of the run lies; an existing one is resumed
    #[arg(long)]
    run_dir: PathBuf,
    /// Episodes of the final comparison; 0 leaves it out
    #[arg(long, default_value_t = 10)]
    eval_episodes: u64,
    /// Stop after this many minutes, with a checkpoint and the final comparison; the same command goes on
    #[arg(long)]
    minutes: Option<f64>,
    /// Where the replay-server listens; a free port by default
    #[arg(long, default_value = "127.0.0.1:0")]
    replay_listen: String,
    /// Where the learner listens; a free port by default
    #[arg(long, default_value = "127.0.0.1:0")]
    learner_listen: String,
    /// A folder made by `isodream secrets`: certificates on both sides, and tokens, also for actors that join from
    /// other machines
    #[arg(long, value_name = "DIR", env = "ISODREAM_SECRETS")]
    secrets: Option<PathBuf>,
    /// Listen where other machines can reach it though nothing guards it
    #[arg(long, env = "ISODREAM_INSECURE")]
    insecure: bool,
    #[command(flatten)]
    page: PageArgs,
}

/// Runs the command.
pub(crate) async fn run(args: TrainArgs) -> anyhow::Result<()> {
    let config = resolve(&args.config, &args.run_dir)?;
    // Everything that can be wrong is told before the run directory is touched.
    let security = DoorArgs::of_train(args.secrets.clone(), args.insecure);
    let dialer = security.client.dialer(Role::Learner)?;
    tokio::task::block_in_place(|| check_environment(&dialer, &config.env))?;
    ensure!(
        config.actor.collectors > 0,
        "actor.collectors: must be greater than 0, or nobody collects experience"
    );
    let limit = args
        .minutes
        .map(|minutes| {
            Duration::try_from_secs_f64(60.0 * minutes)
                .with_context(|| format!("--minutes {minutes}: must be a positive number"))
        })
        .transpose()?;
    let door = security.door()?;
    let page = args.page.open_unless_off().await?;
    let replay = Place::find(&args.replay_listen, &door).await?;
    let learner = Place::find(&args.learner_listen, &door).await?;
    let config_path = args.run_dir.join("config.toml");
    // A role that is restarted reads the file again: nobody else may change it meanwhile.
    let _run_lock = isodream_learner::lock(&args.run_dir, "train")?;
    std::fs::create_dir_all(args.run_dir.join("logs"))
        .with_context(|| format!("cannot write the run directory {}", args.run_dir.display()))?;
    write_whole(&config_path, config.to_toml().as_bytes())?;
    let shutdown = shutdown_on_signal()?;
    let mut processes = Processes::new(&args.run_dir);
    let path = |path: &Path| path.display().to_string();
    let with_config = |role: &str, more: &[&str]| {
        let mut all = vec![
            role.to_owned(),
            "--config".into(),
            path(&config_path),
            "--supervised".into(),
        ];
        if let Some(folder) = &args.secrets {
            all.extend(["--secrets".into(), path(folder)]);
        }
        if args.insecure && role != "actor" {
            all.push("--insecure".into());
        }
        all.extend(more.iter().map(|&arg| arg.to_owned()));
        all
    };
    let store = path(&args.run_dir.join("replay"));
    processes.add(Process::new(
        "replay",
        with_config("replay", &["--dir", &store, "--listen", &replay.listen]),
    ));
    let run_dir = path(&args.run_dir);
    let learner_args = [
        "--run-dir",
        &run_dir,
        "--listen",
        &learner.listen,
        "--replay",
        &replay.reach,
    ];
    processes.add(Process::new(
        "learner",
        with_config("learner", &learner_args),
    ));
    let actor = |id: &str, role: &str| {
        let args = [
            "--id",
            id,
            "--role",
            role,
            "--replay",
            &replay.reach,
            "--learner",
            &learner.reach,
        ];
        Process::new(id, with_config("actor", &args))
    };
    for index in 0..config.actor.collectors {
        processes.add(actor(&format!("actor-{index}"), "collect"));
    }
    processes.add(actor("evaluator", "evaluate"));

    let started = Instant::now();
    let asking = security.client.dialer(Role::Viewer)?;
    // Wrong addresses are told before anything starts.
    asking.learner(&learner.reach)?;
    asking.replay(&replay.reach)?;
    let sources = Sources {
        dialer: asking,
        learner: learner.reach.clone(),
        replay: vec![replay.reach.clone()],
    };
    let mut progress = Progress::new(&config, sources.clone());
    let _showing = page.map(|page| {
        eprintln!("dashboard at {}", page.url());
        let (run_dir, stop) = (args.run_dir.clone(), shutdown.child_token());
        AbortOnDropHandle::new(tokio::spawn(async move {
            if let Err(error) = page.serve(&run_dir, Some(sources), stop).await {
                tracing::warn!(
                    error = format!("{error:#}"),
                    "training goes on without a page"
                );
            }
        }))
    });
    let ended = loop {
        if let Err(error) = processes.tend() {
            processes.stop().await;
            return Err(error);
        }
        if processes.finished("learner") {
            break "training is finished";
        }
        if limit.is_some_and(|limit| started.elapsed() > limit) {
            break "time is up; the same command goes on from here";
        }
        progress.refresh(&processes).await;
        tokio::select! {
            () = shutdown.cancelled() => {}
            () = tokio::time::sleep(TICK) => {}
        }
        if shutdown.is_cancelled() {
            break "interrupted; the same command goes on from here";
        }
    };
    progress.close();
    processes.stop().await;
    eprintln!(
        "{ended} ({:.0} s, {})",
        started.elapsed().as_secs_f64(),
        args.run_dir.display()
    );
    if shutdown.is_cancelled() || args.eval_episodes == 0 {
        return Ok(());
    }
    if Checkpoint::load_newest(&args.run_dir.join("checkpoints"))?.is_none() {
        eprintln!("nothing was trained yet, so that there is nothing to evaluate");
        return Ok(());
    }
    eprintln!("evaluating {} episodes per policy ...", args.eval_episodes);
    let go_on = || !shutdown.is_cancelled();
    let evaluation = tokio::task::block_in_place(|| {
        evaluate(&dialer, &args.run_dir, &[], args.eval_episodes, &go_on)
    })?;
    let file = args.run_dir.join("evaluation.json");
    write_whole(&file, &serde_json::to_vec_pretty(&evaluation)?)?;
    print(&evaluation.table())
}

/// The run's configuration: what is asked for, or what the run directory already has.
fn resolve(asked: &ConfigArgs, run_dir: &Path) -> anyhow::Result<Config> {
    let stored = run_dir.join("config.toml");
    if !stored.exists() {
        return Ok(asked.load()?);
    }
    let old = Config::from_file(&stored)?;
    if asked.is_empty() {
        return Ok(old);
    }
    let new = asked.load()?;
    ensure!(
        new.env == old.env && new.model_hash() == old.model_hash(),
        "{} holds a run with other [env] or [model] settings; choose another --run-dir, or leave the settings out to resume",
        run_dir.display()
    );
    Ok(new)
}

/// Makes one environment, or asks another process what it has.
fn check_environment(dialer: &Dialer, config: &EnvConfig) -> Result<(), EnvError> {
    match remote_address(&config.id) {
        Some(_) => environment_spec(dialer, config, Duration::ZERO).map(drop),
        None => make(config).map(drop),
    }
}

/// Where a role listens, and where the others on this machine find it.
struct Place {
    listen: String,
    reach: String,
}

impl Place {
    /// `address` with port 0 replaced by a free port, which a restarted role can then come back to.
    async fn find(address: &str, door: &Door) -> anyhow::Result<Self> {
        let listener = isodream_rpc::bind(address, door).await?;
        let listen = listener
            .local_addr()
            .context("the listener has no address")?;
        let mut reach = listen;
        if listen.ip().is_unspecified() {
            reach.set_ip(match listen {
                SocketAddr::V4(_) => Ipv4Addr::LOCALHOST.into(),
                SocketAddr::V6(_) => Ipv6Addr::LOCALHOST.into(),
            });
        }
        Ok(Self {
            listen: listen.to_string(),
            reach: reach.to_string(),
        })
    }
}
