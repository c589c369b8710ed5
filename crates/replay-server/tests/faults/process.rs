//! The server as a process of its own: this test binary, started again in another role.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use isodream_core::{Chunk, EnvSpec, ImageShape};
use isodream_proto::Identity;
use isodream_proto::v1::ReplayStatusRequest;
use isodream_replay::{Capacity, LimiterOptions, Selector, StoreOptions, Table};
use isodream_replay_server::{ServedTable, ServerOptions, is_disk_failure, serve};
use isodream_rpc::limits::FAILOVER_AFTER;
use isodream_rpc::{AppendClient, AppendOptions, Door};
use tokio_util::sync::CancellationToken;

/// Longer than anything here takes on a busy machine.
pub(crate) const DEADLINE: Duration = Duration::from_secs(60);
pub(crate) const STEPS: u32 = 10;
/// What the role ends with when its disk failed.
pub(crate) const DISK_FAILED: i32 = 70;

const FOLDER: &str = "ISODREAM_TEST_FOLDER";
const ADDRESS: &str = "ISODREAM_TEST_ADDRESS";
const CAPACITY: &str = "ISODREAM_TEST_CAPACITY_STEPS";

/// The role, not a test: a test binary is the only program with failpoints in it, and `#[ignore]` is what keeps a
/// server that never ends by itself out of a run of the tests. [`ServerProcess`] asks for it by name.
#[test]
#[ignore = "the server process that the other tests start, kill and start again"]
fn server_role() {
    let Ok(folder) = std::env::var(FOLDER) else {
        return;
    };
    let address = std::env::var(ADDRESS).unwrap();
    let capacity_steps = std::env::var(CAPACITY).unwrap().parse().unwrap();
    // Reads FAILPOINTS.
    let _scenario = fail::FailScenario::setup();
    let options = ServerOptions {
        folder: PathBuf::from(folder),
        store: StoreOptions {
            capacity: Capacity::steps(capacity_steps),
            segment_bytes: 64 << 10,
        },
        limiter: LimiterOptions {
            min_steps: 0,
            samples_per_insert: 0.0,
            tolerance_steps: 0.0,
        },
        relay_policy: None,
        tables: vec![ServedTable {
            table: Table::new("train", Selector::Episodes),
            limited: true,
        }],
        door: Door::default(),
    };
    let served = tokio::runtime::Runtime::new().unwrap().block_on(async {
        let listener = isodream_rpc::bind(&address, &Door::default()).await?;
        serve(options, listener, CancellationToken::new()).await
    });
    let error = served.unwrap_err();
    eprintln!("{error:#}");
    std::process::exit(if is_disk_failure(&error) {
        DISK_FAILED
    } else {
        1
    });
}

/// A server process; killed when it is dropped.
pub(crate) struct ServerProcess {
    child: Child,
}

impl ServerProcess {
    pub(crate) fn start(
        folder: &Path,
        address: &str,
        capacity_steps: u64,
        failpoints: &str,
    ) -> Self {
        let child = Command::new(std::env::current_exe().unwrap())
            .args(["process::server_role", "--exact", "--ignored"])
            .env(FOLDER, folder)
            .env(ADDRESS, address)
            .env(CAPACITY, capacity_steps.to_string())
            .env("FAILPOINTS", failpoints)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        Self { child }
    }

    /// The status of a process that has ended.
    pub(crate) fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().unwrap()
    }

    /// Memory of the process that is in use.
    pub(crate) fn resident_bytes(&self) -> u64 {
        let status = format!("/proc/{}/status", self.child.id());
        let status = std::fs::read_to_string(status).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
        let kilobytes: u64 = line
            .unwrap()
            .trim()
            .trim_end_matches(" kB")
            .parse()
            .unwrap();
        kilobytes << 10
    }

    pub(crate) fn kill(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    /// Waits until the process ends by itself.
    pub(crate) fn wait(&mut self) -> ExitStatus {
        let since = Instant::now();
        loop {
            if let Some(status) = self.ended() {
                return status;
            }
            assert!(since.elapsed() < DEADLINE, "the server does not end");
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        self.kill();
    }
}

/// An address that nobody listens on.
pub(crate) fn free_address() -> String {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    listener.local_addr().unwrap().to_string()
}

/// Steps inserted, once the server answers.
pub(crate) async fn inserted_steps(address: &str) -> u64 {
    let since = Instant::now();
    loop {
        let mut client = isodream_rpc::Dialer::default().replay(address).unwrap();
        match client.status(ReplayStatusRequest {}).await {
            Ok(status) => return status.into_inner().inserted_steps,
            Err(status) => assert!(since.elapsed() < DEADLINE, "{status}"),
        }
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
}

pub(crate) fn identity() -> Identity {
    let spec = EnvSpec {
        id: "highway/day".to_owned(),
        image: ImageShape {
            height: 2,
            width: 2,
            channels: 3,
        },
        action_dim: 2,
        action_repeat: 1,
        time_limit: 100,
    };
    Identity::new(&spec, "")
}

pub(crate) fn actor(address: &str, number: u64) -> AppendClient {
    AppendClient::start(
        &isodream_rpc::Dialer::default(),
        AppendOptions {
            addresses: vec![address.to_owned()],
            identity: identity(),
            actor_id: format!("actor-{number}"),
            spool_chunks: 4,
            spool_bytes: usize::MAX,
            failover_after: FAILOVER_AFTER,
        },
    )
    .unwrap()
}

/// Chunk `seq` of the only episode of an actor.
pub(crate) fn chunk(actor: u64, seq: u64) -> Chunk {
    Chunk {
        actor_id: format!("actor-{actor}"),
        epoch: 1,
        seq,
        episode_id: actor,
        first_step: seq as u32 * STEPS,
        steps: STEPS,
        ends_episode: false,
        payload: (0..300_u64)
            .map(|byte| (byte * 31 + seq * 7 + actor) as u8)
            .collect(),
    }
}
