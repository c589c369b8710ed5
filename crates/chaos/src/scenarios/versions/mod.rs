//! Builds of different protocol versions that meet.

mod old;

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use isodream_proto::PROTOCOL_VERSION;
use isodream_proto::v1::environment_service_server::EnvironmentServiceServer;
use isodream_proto::v1::learner_service_server::LearnerServiceServer;
use isodream_proto::v1::replay_service_server::ReplayServiceServer;
use isodream_rpc::{Dialer, Door};
use tokio_util::sync::CancellationToken;
use tonic::Code;

use self::old::Old;
use super::calls::{self, Addresses, Call, STRANGER};
use super::{Context, RECOVERY};
use crate::cluster::Cluster;
use crate::interrupt;
use crate::plan::{Plan, free_address};
use crate::role::{Role, RoleSpec};
use crate::settings::Settings;
use crate::table::Row;
use crate::watch::Inserts;

/// The version of the other build.
const OTHER: u32 = PROTOCOL_VERSION + 1;

/// How long a refusal may take.
const REFUSAL: Duration = Duration::from_secs(30);

pub(super) fn run(context: &Context) -> Result<Vec<Row>> {
    let cluster = Cluster::start(&context.binary, Plan::usual(&[]))?;
    let mut row = Row::new(
        "an old client at a new server",
        "raw gRPC with another protocol version: Append, Sample, WatchPolicy",
    );
    let refused = old_clients(&cluster, &mut row);
    row.take(refused);
    let at = Instant::now();
    row.recovered(cluster.watch.recovery(at, Inserts::Any, RECOVERY));
    let mut failures = Vec::new();
    let audit = cluster.finish(&mut failures, |chunk| {
        ensure!(
            chunk.actor_id != STRANGER,
            "a chunk of a refused client is stored"
        );
        Ok(())
    })?;
    row.audit = Some(audit);
    row.failures.extend(failures);
    let mut reverse = Row::new(
        "a new client at an old server",
        "actor and learner at servers that answer as another version does: replay, learner, environment",
    );
    let refused = new_clients(&context.binary, &mut reverse);
    reverse.take(refused);
    Ok(vec![row, reverse])
}

/// Asks a running training for everything that begins with a handshake.
fn old_clients(cluster: &Cluster, row: &mut Row) -> Result<()> {
    let addresses = Addresses {
        replay: cluster.layout.replays[0].clone(),
        learner: cluster.layout.learner.clone(),
        // A training on built-in environments has no server for them.
        environment: String::new(),
    };
    for call in [Call::Append, Call::Sample, Call::WatchPolicy] {
        row.tried += 1;
        let made = calls::make(Dialer::default(), addresses.clone(), call, OTHER);
        let Err(status) = cluster.probe.run(made)? else {
            bail!("{call:?} was answered");
        };
        let words = format!("protocol version {OTHER} does not match {PROTOCOL_VERSION}");
        ensure!(
            status.code() == Code::FailedPrecondition && status.message().contains(&words),
            "{call:?} was refused with {status}"
        );
        row.notes.push(format!("{call:?}: {}", status.message()));
    }
    Ok(())
}

/// Starts roles of this build at servers of the other one: each has to end with the reason.
fn new_clients(binary: &Path, row: &mut Row) -> Result<()> {
    let folder = tempfile::tempdir()?;
    let address = free_address()?;
    let shutdown = CancellationToken::new();
    let _stop = shutdown.clone().drop_guard();
    let runtime = tokio::runtime::Runtime::new()?;
    let listener = runtime.block_on(isodream_rpc::bind(&address, &Door::default()))?;
    let router = isodream_rpc::server(&Door::default())?
        .add_service(ReplayServiceServer::new(Old))
        .add_service(LearnerServiceServer::new(Old))
        .add_service(EnvironmentServiceServer::new(Old));
    runtime.spawn(isodream_rpc::serve(router, listener, shutdown));
    let at = ["--replay", &address];
    let id = ["--id", "actor-0", "--learner", &address];
    let environment = format!("env.id=grpc://{address}");
    let run_dir = folder.path().join("run").display().to_string();
    let listen = free_address()?;
    let learner = ["learner", "--run-dir", &run_dir, "--listen", &listen];
    let attempts: [(&str, Vec<&str>, &[&str]); 4] = [
        ("actor at replay", [&["actor"], &id[..], &at].concat(), &[]),
        (
            "evaluator at learner",
            [&["actor", "--role", "evaluate"], &id[..], &at].concat(),
            &[],
        ),
        ("learner at replay", [&learner[..], &at].concat(), &[]),
        (
            "actor at environment",
            [&["actor"], &id[..], &at].concat(),
            &[&environment],
        ),
    ];
    for (number, (what, args, settings)) in attempts.into_iter().enumerate() {
        row.tried += 1;
        let mut command = vec![binary.display().to_string()];
        command.extend(args.into_iter().map(str::to_owned));
        command.push("--supervised".into());
        command.extend(Settings::for_faults(1, settings).args());
        let role = Role::start(RoleSpec {
            name: what.into(),
            command,
            env: Vec::new(),
            log: folder.path().join(format!("{number}.log")),
        })?;
        let status = interrupt::until(&format!("{what} ends"), REFUSAL, || {
            Ok(role.exits().first().copied())
        });
        role.hold();
        let log = role.log_since(0)?;
        let status = status.with_context(|| log.clone())?;
        let words = "protocol version";
        let line = log.lines().rev().find(|line| line.contains(words));
        let line = line.with_context(|| format!("{what} does not say `{words}`: {log}"))?;
        ensure!(
            status.code() == Some(1),
            "{what} ended with {status} instead of 1"
        );
        row.notes.push(format!("{what}: {line}"));
    }
    Ok(())
}
