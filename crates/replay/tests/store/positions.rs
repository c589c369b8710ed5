//! Exactly once, fencing, identity, one writer.

use isodream_core::Chunk;
use isodream_replay::{Outcome, ReplayError, Store, StoreIdentity};

use crate::common::{ALL, episode, open, read, sampler, store_all};

#[test]
fn a_chunk_sent_twice_is_stored_once_and_a_gap_is_answered() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, store, _) = open(folder.path(), &ALL);
    assert_eq!(writer.begin("a", 1, 0).unwrap(), 0);
    let mut group = episode(0..3);
    group.push(group[1].clone());
    group.push(episode(7..8).remove(0));
    assert_eq!(
        writer.commit(group).unwrap(),
        [
            Outcome::Stored { next_seq: 1 },
            Outcome::Stored { next_seq: 2 },
            Outcome::Stored { next_seq: 3 },
            Outcome::Duplicate { next_seq: 3 },
            Outcome::Gap { expected_seq: 3 },
        ]
    );
    assert_eq!(store.stats().steps, 30);
    drop(writer);
    let (mut writer, store, recovery) = open(folder.path(), &ALL);
    assert_eq!(recovery.chunks, 3);
    assert_eq!(store.stats().inserted_steps, 30);
    assert_eq!(writer.begin("a", 1, 0).unwrap(), 3);
    assert_eq!(
        writer.commit(episode(2..4)).unwrap(),
        [
            Outcome::Duplicate { next_seq: 3 },
            Outcome::Stored { next_seq: 4 }
        ]
    );
    let whole = sampler(&store, 0, 40).draw().unwrap();
    assert_eq!(read(&whole, 40).1, (0..40).collect::<Vec<_>>());
}

#[test]
fn an_invalid_chunk_is_refused_without_harm_to_its_group() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, store, _) = open(folder.path(), &ALL);
    let mut group = episode(0..2);
    group.insert(
        1,
        Chunk {
            steps: 0,
            ..group[0].clone()
        },
    );
    let outcomes = writer.commit(group).unwrap();
    assert!(matches!(&outcomes[1], Outcome::Invalid { reason } if reason.contains("no steps")));
    assert_eq!(outcomes[2], Outcome::Stored { next_seq: 2 });
    assert_eq!(store.stats().steps, 20);
}

#[test]
fn an_older_epoch_is_fenced_off_even_after_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, _, _) = open(folder.path(), &ALL);
    writer.begin("a", 1, 0).unwrap();
    store_all(&mut writer, episode(0..2));
    // No chunk of epoch 2 follows: the fence itself has to be durable.
    assert_eq!(writer.begin("a", 2, 0).unwrap(), 0);
    assert_eq!(
        writer.commit(episode(2..3)).unwrap(),
        [Outcome::Fenced { newer_epoch: 2 }]
    );
    drop(writer);
    let (mut writer, _, _) = open(folder.path(), &ALL);
    let error = writer.begin("a", 1, 2).unwrap_err();
    assert!(
        matches!(error, ReplayError::Fenced { newer: 2, .. }),
        "{error}"
    );
    assert_eq!(
        writer.commit(episode(2..3)).unwrap(),
        [Outcome::Fenced { newer_epoch: 2 }]
    );
    assert_eq!(writer.begin("b", 1, 0).unwrap(), 0, "other actors are free");
}

#[test]
fn an_actor_goes_on_where_a_reset_store_knows_less_than_it() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, _, _) = open(folder.path(), &ALL);
    assert_eq!(writer.begin("a", 1, 57).unwrap(), 57);
    store_all(&mut writer, episode(57..58));
    drop(writer);
    let (mut writer, _, _) = open(folder.path(), &ALL);
    assert_eq!(writer.begin("a", 1, 57).unwrap(), 58);
}

#[test]
fn numbers_that_nobody_counts_to_and_endless_names_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (mut writer, _, _) = open(folder.path(), &ALL);
    let long = "a".repeat(256);
    let refusals = [
        writer.epoch_for(&long, 7, 0).unwrap_err(),
        writer.epoch_for("a", 7, u64::MAX).unwrap_err(),
        writer.begin(&long, 1, 0).unwrap_err(),
        writer.begin("a", u64::MAX, 0).unwrap_err(),
        writer.begin("a", 1, u64::MAX).unwrap_err(),
    ];
    for error in refusals {
        assert!(matches!(error, ReplayError::InvalidChunk { .. }), "{error}");
    }
    let beyond = Chunk {
        epoch: u64::MAX,
        ..episode(0..1).remove(0)
    };
    let outcomes = writer.commit(vec![beyond]).unwrap();
    assert!(matches!(&outcomes[0], Outcome::Invalid { reason } if reason.contains("counting")));
    assert_eq!(writer.epoch_for("a", 7, 5).unwrap(), 5);
    assert_eq!(writer.begin("a", 5, 3).unwrap(), 3, "nobody is locked out");
}

#[test]
fn the_first_identity_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let identity = |hash: &str| StoreIdentity {
        env_spec_hash: hash.into(),
        env_spec: format!("environment {hash}"),
    };
    let (mut writer, _, _) = open(folder.path(), &ALL);
    assert_eq!(
        writer.adopt_identity(&identity("a")).unwrap(),
        identity("a")
    );
    drop(writer);
    let (mut writer, _, _) = open(folder.path(), &ALL);
    assert_eq!(
        writer.adopt_identity(&identity("b")).unwrap(),
        identity("a")
    );
}

#[test]
fn a_second_store_on_the_folder_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (_writer, _, _) = open(folder.path(), &ALL);
    assert!(matches!(
        Store::open(folder.path(), &ALL),
        Err(ReplayError::FolderInUse { .. })
    ));
}
