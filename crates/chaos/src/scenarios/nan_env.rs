//! An environment that answers NaN.

use std::num::NonZeroUsize;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use isodream_core::config::EnvConfig;
use isodream_core::{Chunk, EnvSpec, codec};
use isodream_envs::{EnvError, Environment, PrivilegedView, Transition};
use isodream_rpc::{Door, EnvironmentServer};
use tokio_util::sync::CancellationToken;

use super::{Context, RECOVERY};
use crate::cluster::Cluster;
use crate::interrupt;
use crate::plan::{Plan, free_address};
use crate::settings::Settings;
use crate::table::Row;
use crate::watch::Inserts;

/// Environments: one for each of three actors, the evaluator among them, and one to spare.
const ENVIRONMENTS: usize = 4;

/// One episode in so many has a NaN in it.
const ONE_IN: u64 = 3;

/// The step whose reward is NaN.
const FAULTY_STEP: u32 = 25;

/// How long the training has to put up with it.
const LONG_ENOUGH: Duration = Duration::from_secs(40);

/// A sound environment, but for single rewards.
struct Faulty {
    env: Box<dyn Environment>,
    episode: u64,
    step: u32,
}

impl Environment for Faulty {
    fn spec(&self) -> &EnvSpec {
        self.env.spec()
    }

    fn reset(&mut self, seed: u64) -> Result<Transition, EnvError> {
        self.episode += 1;
        self.step = 0;
        self.env.reset(seed)
    }

    fn step(&mut self, action: &[f32]) -> Result<Transition, EnvError> {
        self.step += 1;
        let mut transition = self.env.step(action)?;
        if self.step == FAULTY_STEP && self.episode.is_multiple_of(ONE_IN) {
            transition.reward = f32::NAN;
        }
        Ok(transition)
    }

    fn segmentation(&self) -> Option<Vec<u8>> {
        self.env.segmentation()
    }

    fn metrics(&self) -> Vec<(&'static str, f64)> {
        self.env.metrics()
    }

    fn privileged(&self) -> Option<PrivilegedView> {
        self.env.privileged()
    }
}

pub(super) fn run(context: &Context) -> Result<Vec<Row>> {
    let address = free_address()?;
    let shutdown = CancellationToken::new();
    let _stop = shutdown.clone().drop_guard();
    serve(&address, shutdown)?;
    let id = format!("env.id=grpc://{address}");
    let plan = Plan {
        settings: Settings::for_faults(2, &[&id]),
        ..Plan::usual(&[])
    };
    let cluster = Cluster::start(&context.binary, plan)?;
    let mut row = Row::new(
        "NaN from an environment",
        &format!("reward {FAULTY_STEP} of every {ONE_IN}rd episode of a gRPC environment is NaN"),
    );
    let survived = survive(&cluster, &mut row);
    row.take(survived);
    let mut failures = Vec::new();
    let audit = cluster.finish(&mut failures, is_finite)?;
    row.audit = Some(audit);
    row.notes.push(format!(
        "all of the {} steps that are stored are finite",
        audit.stored_steps
    ));
    row.failures.extend(failures);
    Ok(vec![row])
}

/// Lets NaNs come for a while, and sees the training go on all the same.
fn survive(cluster: &Cluster, row: &mut Row) -> Result<()> {
    let before = cluster.watch.updates();
    interrupt::sleep(LONG_ENOUGH)?;
    cluster
        .watch
        .recovery(Instant::now(), Inserts::Any, RECOVERY)?;
    let updates = cluster.watch.updates() - before;
    row.notes.push(format!(
        "{updates} updates within {} s",
        LONG_ENOUGH.as_secs()
    ));
    for role in cluster
        .roles()
        .filter(|role| role.name().starts_with("actor-"))
    {
        let log = role.log_since(0)?;
        let lines: Vec<_> = log
            .lines()
            .filter(|line| {
                line.contains("the environment failed, a new episode begins")
                    && line.contains("NaN")
            })
            .collect();
        ensure!(!lines.is_empty(), "{} met no NaN", role.name());
        ensure!(role.exits().is_empty(), "{} ended", role.name());
        row.tried += lines.len();
        if row.notes.len() == 1 {
            row.notes
                .push(format!("{} says: {}", role.name(), lines[0]));
        }
    }
    Ok(())
}

/// What is stored has to be finite.
fn is_finite(chunk: &Chunk) -> Result<()> {
    let steps = codec::decode(&chunk.payload)?;
    let mut numbers = steps
        .rewards
        .iter()
        .chain(&steps.actions)
        .chain(&steps.discounts);
    ensure!(
        numbers.all(|number| number.is_finite()),
        "chunk {} of {} holds a number that is not finite",
        chunk.seq,
        chunk.actor_id
    );
    Ok(())
}

/// Serves faulty environments in a thread of their own until `shutdown` is cancelled.
fn serve(address: &str, shutdown: CancellationToken) -> Result<()> {
    let config = EnvConfig {
        time_limit: 40,
        ..EnvConfig::default()
    };
    let environments = (0..ENVIRONMENTS)
        .map(|_| {
            let env = isodream_envs::make(&config)?;
            Ok(Box::new(Faulty {
                env,
                episode: 0,
                step: 0,
            }) as Box<dyn Environment>)
        })
        .collect::<Result<Vec<_>, EnvError>>()?;
    let server = EnvironmentServer::new(environments, NonZeroUsize::MIN)?;
    let runtime = tokio::runtime::Runtime::new()?;
    let listener = runtime.block_on(isodream_rpc::bind(address, &Door::default()))?;
    std::thread::Builder::new()
        .name("faulty environments".into())
        .spawn(move || {
            if let Err(error) = runtime.block_on(server.serve(listener, Door::default(), shutdown))
            {
                eprintln!("the faulty environments ended: {error}");
            }
        })?;
    Ok(())
}
