//! Looking into a folder: sums, damage, and a writer at work.

#![allow(clippy::unwrap_used, missing_docs)]

use std::fs;
use std::path::Path;

use isodream_core::Chunk;
use isodream_replay::{
    Capacity, ReplayError, Store, StoreIdentity, StoreOptions, StoreWriter, find_chunk,
    for_each_chunk, inspect, verify,
};

const OPTIONS: StoreOptions = StoreOptions {
    capacity: Capacity::UNLIMITED,
    segment_bytes: 1000,
};

/// Chunk `seq` of actor `a`: three chunks of ten steps an episode.
fn chunk(seq: u64) -> Chunk {
    Chunk {
        actor_id: "a".into(),
        epoch: 4,
        seq,
        episode_id: seq / 3,
        first_step: (seq % 3) as u32 * 10,
        steps: 10,
        ends_episode: seq % 3 == 2,
        payload: vec![seq as u8; 200].into(),
    }
}

/// A folder with 20 chunks: six whole episodes and a growing one. The writer is still open.
fn filled(folder: &Path) -> StoreWriter {
    let (mut writer, _, _) = Store::open(folder, &OPTIONS).unwrap();
    writer
        .adopt_identity(&StoreIdentity {
            env_spec_hash: "00ff".into(),
            env_spec: "highway/day".into(),
        })
        .unwrap();
    writer.begin("a", 4, 0).unwrap();
    for seq in 0..20 {
        writer.commit(vec![chunk(seq)]).unwrap();
    }
    writer
}

#[test]
fn a_folder_is_summed_up_while_its_writer_works() {
    let folder = tempfile::tempdir().unwrap();
    let _writer = filled(folder.path());
    let report = inspect(folder.path()).unwrap();
    assert_eq!(report.identity.unwrap().env_spec, "highway/day");
    assert!(report.segments.len() > 3);
    let steps: u64 = report.segments.iter().map(|segment| segment.steps).sum();
    assert_eq!((steps, report.inserted_steps), (200, 200));
    let episodes = report.episodes;
    assert_eq!((episodes.count, episodes.complete), (7, 6));
    assert_eq!((episodes.shortest, episodes.longest), (20, 30));
    assert_eq!(report.actors.len(), 1);
    assert_eq!((report.actors[0].epoch, report.actors[0].next_seq), (4, 20));
    assert!(report.damage.is_empty());
    let whole = verify(folder.path()).unwrap();
    assert!(whole.damage.is_empty());
    let bytes: u64 = report.segments.iter().map(|segment| segment.bytes).sum();
    assert_eq!(whole.bytes, bytes);
    let records: u64 = report.segments.iter().map(|segment| segment.records).sum();
    assert_eq!(whole.records, records);
    serde_json::to_string(&inspect(folder.path()).unwrap()).unwrap();
}

#[test]
fn a_half_written_tail_is_no_damage() {
    let folder = tempfile::tempdir().unwrap();
    drop(filled(folder.path()));
    let newest = inspect(folder.path()).unwrap().segments.pop().unwrap();
    let mut content = fs::read(&newest.path).unwrap();
    content.extend_from_slice(&[7; 33]);
    fs::write(&newest.path, content).unwrap();
    for (damage, unfinished) in [
        inspect(folder.path()).map(|report| (report.damage, report.unfinished_bytes)),
        verify(folder.path()).map(|report| (report.damage, report.unfinished_bytes)),
    ]
    .map(Result::unwrap)
    {
        assert_eq!(damage, []);
        assert_eq!(unfinished, 33);
    }
}

#[test]
fn verifying_finds_every_damaged_byte_and_inspecting_every_damaged_header() {
    let folder = tempfile::tempdir().unwrap();
    drop(filled(folder.path()));
    let second = inspect(folder.path()).unwrap().segments.remove(1);
    let content = fs::read(&second.path).unwrap();
    for at in (0..content.len()).step_by(11) {
        let mut bytes = content.clone();
        bytes[at] ^= 0x40;
        fs::write(&second.path, &bytes).unwrap();
        let report = verify(folder.path()).unwrap();
        assert_eq!(report.damage.len(), 1, "byte {at}");
        let damage = &report.damage[0];
        assert_eq!(damage.segment, second.path);
        assert!((damage.offset..damage.offset + damage.bytes).contains(&(at as u64)));
        let in_a_chunk = damage.offset > 0 && damage.reason.contains("payload");
        assert_eq!(
            inspect(folder.path()).unwrap().damage.is_empty(),
            in_a_chunk
        );
    }
}

#[test]
fn a_chunk_is_found_by_episode_and_step() {
    let folder = tempfile::tempdir().unwrap();
    let _writer = filled(folder.path());
    for (episode, step, seq) in [(0, 0, 0), (2, 15, 7), (6, 19, 19)] {
        let found = find_chunk(folder.path(), episode, step).unwrap();
        assert_eq!(found, Some(chunk(seq)));
    }
    assert_eq!(find_chunk(folder.path(), 6, 20).unwrap(), None);
    assert_eq!(find_chunk(folder.path(), 99, 0).unwrap(), None);
}

#[test]
fn every_chunk_is_read_in_order_and_a_damaged_one_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    drop(filled(folder.path()));
    let mut seen = Vec::new();
    for_each_chunk::<ReplayError>(folder.path(), |chunk| {
        seen.push(chunk);
        Ok(())
    })
    .unwrap();
    assert!(!seen.is_empty());
    let expected: Vec<_> = (0..seen.len() as u64).map(chunk).collect();
    assert_eq!(seen, expected);

    let damaged = inspect(folder.path()).unwrap().segments.remove(1).path;
    let mut bytes = fs::read(&damaged).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&damaged, bytes).unwrap();
    let error = for_each_chunk::<ReplayError>(folder.path(), |_| Ok(())).unwrap_err();
    assert!(matches!(error, ReplayError::Damaged { .. }), "{error}");
}
