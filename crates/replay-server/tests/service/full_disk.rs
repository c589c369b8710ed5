//! A disk that is really full: a small tmpfs.

use std::path::Path;
use std::process::Command;

use crate::common::{DEADLINE, NO_LIMIT, STEPS, Server, actor, appending, chunk, learner, until};
use isodream_proto::v1::ReplayStatusRequest;
use isodream_replay::{Store, StoreOptions, verify};
use isodream_rpc::{AppendClient, AppendOptions};

/// A mounted tmpfs of 256 KiB; unmounted at the end.
struct SmallDisk(tempfile::TempDir);

impl SmallDisk {
    /// None where mounting is not allowed.
    fn mount() -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", "size=256k", "tmpfs"])
            .arg(folder.path())
            .output()
            .is_ok_and(|output| output.status.success());
        mounted.then_some(Self(folder))
    }

    fn path(&self) -> &Path {
        self.0.path()
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.path()).status();
    }
}

#[test]
fn a_full_disk_holds_inserts_until_there_is_room_and_sampling_goes_on() {
    let Some(disk) = SmallDisk::mount() else {
        eprintln!("skipped: mounting a tmpfs takes root");
        return;
    };
    let folder = disk.path().join("store");
    let server = Server::start(&folder, NO_LIMIT);
    let filler = disk.path().join("filler");
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let sent = runtime.block_on(async {
        let actor = actor(&server.address, 8);
        for index in 0..20 {
            actor.send(chunk(index)).await.unwrap();
        }
        actor.flush(DEADLINE).await.unwrap();
        let mut learner = learner(&server.address, 10);
        std::fs::write(&filler, vec![1; 200 << 10]).unwrap();

        // The disk takes some more chunks, then the spool fills up and says why.
        let mut sent = 20;
        let why = loop {
            let next = chunk(sent);
            tokio::select! {
                result = actor.send(next) => { result.unwrap(); sent += 1; }
                why = until("the disk is full", || actor.waiting().filter(|why| why.contains("no space"))) => break why,
            }
            assert!(sent < 1000, "the disk never was full");
        };
        assert!(why.contains("free space"), "{why}");
        assert!(actor.unacknowledged() > 0);

        for _ in 0..20 {
            tokio::time::timeout(DEADLINE, learner.next()).await.unwrap().unwrap();
        }
        let status = isodream_rpc::Dialer::default().replay(&server.address)
            .unwrap()
            .status(ReplayStatusRequest {})
            .await
            .unwrap()
            .into_inner();
        assert!(status.insert_waiting.contains("no space"), "{status:?}");

        // A newcomer is no worse off.
        let newcomer = AppendClient::start(&isodream_rpc::Dialer::default(), AppendOptions {
            actor_id: "newcomer".into(),
            ..appending(&server.address, 1)
        })
        .unwrap();
        newcomer.send(chunk(0)).await.unwrap();
        until("the newcomer hears of the disk", || {
            newcomer.waiting().filter(|why| why.contains("no space"))
        })
        .await;

        std::fs::remove_file(&filler).unwrap();
        actor.flush(DEADLINE).await.unwrap();
        newcomer.flush(DEADLINE).await.unwrap();
        until("nobody waits", || actor.waiting().is_none().then_some(())).await;
        sent
    });
    server.stop().unwrap();
    assert_eq!(verify(&folder).unwrap().damage, []);
    let (_, store, recovery) = Store::open(&folder, &StoreOptions::default()).unwrap();
    assert_eq!(recovery.chunks, sent + 1);
    assert_eq!(store.stats().inserted_steps, (sent + 1) * u64::from(STEPS));
}
