#![allow(clippy::unwrap_used)]

use std::path::PathBuf;

use isodream_core::Chunk;
use proptest::prelude::*;

use super::*;

fn chunk(seq: u64) -> Chunk {
    Chunk {
        actor_id: "actor-0".into(),
        epoch: 1,
        seq,
        episode_id: 0,
        first_step: seq as u32 * 10,
        steps: 10,
        ends_episode: false,
        payload: vec![seq as u8; 40].into(),
    }
}

fn append(log: &mut SegmentLog, seqs: std::ops::Range<u64>) -> Vec<ChunkRef> {
    let records: Vec<_> = seqs.map(|seq| Record::Chunk(chunk(seq))).collect();
    log.append(&records, Snapshot::default).unwrap().chunks
}

/// Opens the log; the sequence numbers it found, and what it reported.
fn open(folder: &Path) -> (SegmentLog, Vec<u64>, LogRecovery) {
    let mut seqs = Vec::new();
    let (log, recovery) =
        SegmentLog::open_with(Folder::open(folder).unwrap(), 1 << 20, &mut |record| {
            if let Recovered::Chunk(found, place) = record {
                // Of closed segments, opening does not read the payloads.
                match place.read() {
                    Ok(whole) => assert_eq!(whole, chunk(found.seq)),
                    Err(error) => assert!(matches!(error, ReplayError::Damaged { .. })),
                }
                seqs.push(found.seq);
            }
        })
        .unwrap();
    (log, seqs, recovery)
}

/// Takes back what a log notes when it is closed, as if its process had died instead.
fn forget_durable(folder: &Path) {
    fs::remove_file(folder.join("DURABLE")).unwrap();
}

fn segment_path(folder: &Path, number: u64) -> PathBuf {
    Segment::path_of(folder, number)
}

#[test]
fn written_is_not_durable_before_the_sync() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = SegmentLog::open(folder.path(), 1 << 20).unwrap();
    append(&mut log, 0..3);
    let written = log.written();
    assert!(log.durable().0 < written.0);
    assert_eq!(log.sync().unwrap().0, written.0);
    assert_eq!(log.durable().0, written.0);
}

#[test]
fn a_cut_at_every_byte_of_the_tail_keeps_everything_before_it() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = SegmentLog::open(folder.path(), 1 << 20).unwrap();
    append(&mut log, 0..3);
    log.sync().unwrap();
    let tail = append(&mut log, 3..4).remove(0);
    log.sync().unwrap();
    drop(log);
    let path = segment_path(folder.path(), 1);
    let content = fs::read(&path).unwrap();
    assert_eq!(tail.offset + tail.stored_bytes(), content.len() as u64);
    for end in tail.offset..content.len() as u64 {
        fs::write(&path, &content[..end as usize]).unwrap();
        forget_durable(folder.path());
        let (mut log, seqs, recovery) = open(folder.path());
        assert_eq!(seqs, [0, 1, 2], "cut to {end} bytes");
        assert_eq!(recovery.torn_bytes, end - tail.offset);
        assert!(recovery.quarantined.is_empty());
        // Life goes on, and the cut is not reported twice.
        append(&mut log, 3..5);
        log.sync().unwrap();
        drop(log);
        let (_, seqs, recovery) = open(folder.path());
        assert_eq!(seqs, [0, 1, 2, 3, 4]);
        assert_eq!(recovery.torn_bytes, 0);
        assert!(recovery.quarantined.is_empty());
    }
}

#[test]
fn garbage_behind_the_end_is_a_torn_tail() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = SegmentLog::open(folder.path(), 1 << 20).unwrap();
    append(&mut log, 0..3);
    log.sync().unwrap();
    drop(log);
    let path = segment_path(folder.path(), 1);
    let mut content = fs::read(&path).unwrap();
    content.extend_from_slice(&[0; 100]);
    fs::write(&path, &content).unwrap();
    let (_, seqs, recovery) = open(folder.path());
    assert_eq!(seqs, [0, 1, 2]);
    assert_eq!(recovery.torn_bytes, 100);
}

#[test]
fn the_end_of_a_log_that_was_closed_is_known() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = SegmentLog::open(folder.path(), 1 << 20).unwrap();
    append(&mut log, 0..1);
    log.sync().unwrap();
    let group = append(&mut log, 1..4);
    log.sync().unwrap();
    drop(log);
    let path = segment_path(folder.path(), 1);
    let content = fs::read(&path).unwrap();
    // All of the newest group was durable, so that this is damage and no torn write ...
    let mut bytes = content.clone();
    bytes[group[1].offset as usize + 70] ^= 1;
    fs::write(&path, &bytes).unwrap();
    let (_, seqs, recovery) = open(folder.path());
    assert_eq!(seqs, [0, 1, 3]);
    assert_eq!((recovery.torn_bytes, recovery.quarantined.len()), (0, 1));
    // ... and so is a cut between two records.
    let end = group[2].offset as usize;
    fs::write(&path, &content[..end]).unwrap();
    let (mut log, seqs, recovery) = open(folder.path());
    assert_eq!(seqs, [0, 1, 2]);
    assert_eq!(recovery.quarantined.len(), 1);
    assert_eq!(recovery.quarantined[0].offset, end as u64);
    assert_eq!(recovery.quarantined[0].bytes, (content.len() - end) as u64);
    // A torn write into the room of what is lost is one again.
    let torn = append(&mut log, 3..4).remove(0);
    fs::write(&path, &fs::read(&path).unwrap()[..torn.offset as usize + 5]).unwrap();
    drop(log);
    let (_, seqs, recovery) = open(folder.path());
    assert_eq!(seqs, [0, 1, 2]);
    assert_eq!((recovery.torn_bytes, recovery.quarantined.len()), (5, 0));
}

#[test]
fn a_closed_segment_cut_between_two_records_is_missed() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = SegmentLog::open(folder.path(), 1).unwrap();
    let group = append(&mut log, 0..2);
    append(&mut log, 2..4);
    log.sync().unwrap();
    drop(log);
    let path = segment_path(folder.path(), 1);
    let content = fs::read(&path).unwrap();
    fs::write(&path, &content[..group[1].offset as usize]).unwrap();
    let (_, seqs, recovery) = open(folder.path());
    assert_eq!(seqs, [0, 2, 3]);
    assert_eq!(recovery.quarantined.len(), 1);
    assert_eq!(recovery.quarantined[0].reason, "its end is missing");
    assert_eq!(recovery.quarantined[0].bytes, group[1].stored_bytes());
}

#[test]
fn a_damaged_payload_of_a_closed_segment_is_found_when_it_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = SegmentLog::open(folder.path(), 1).unwrap();
    let group = append(&mut log, 0..2);
    append(&mut log, 2..4);
    log.sync().unwrap();
    drop(log);
    let path = segment_path(folder.path(), 1);
    let mut content = fs::read(&path).unwrap();
    content[(group[1].offset - 1) as usize] ^= 1;
    fs::write(&path, &content).unwrap();
    let mut unreadable = Vec::new();
    let (_, recovery) =
        SegmentLog::open_with(Folder::open(folder.path()).unwrap(), 1, &mut |record| {
            if let Recovered::Chunk(found, place) = record
                && place.read().is_err()
            {
                unreadable.push(found.seq);
            }
        })
        .unwrap();
    assert!(recovery.quarantined.is_empty());
    assert_eq!(unreadable, [0]);
}

#[test]
fn a_hole_in_the_newest_group_ends_it_there() {
    // The kernel may write a group's later pages first. Record 2 was never acknowledged then, and neither was
    // 3: keeping 3 would tell the actor that 2 is durable.
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = SegmentLog::open(folder.path(), 1 << 20).unwrap();
    append(&mut log, 0..1);
    log.sync().unwrap();
    let group = append(&mut log, 1..4);
    drop(log);
    let path = segment_path(folder.path(), 1);
    let mut content = fs::read(&path).unwrap();
    let hole = group[1].offset as usize..group[2].offset as usize;
    content[hole].fill(0);
    fs::write(&path, &content).unwrap();
    let (_, seqs, recovery) = open(folder.path());
    assert_eq!(seqs, [0, 1]);
    assert!(recovery.quarantined.is_empty());
    assert_eq!(recovery.torn_bytes, content.len() as u64 - group[1].offset);
}

#[test]
fn damage_before_the_newest_group_is_quarantined_alone() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = SegmentLog::open(folder.path(), 1 << 20).unwrap();
    let group = append(&mut log, 0..3);
    log.sync().unwrap();
    append(&mut log, 3..5);
    log.sync().unwrap();
    drop(log);
    let path = segment_path(folder.path(), 1);
    let content = fs::read(&path).unwrap();
    let damaged = &group[1];
    // Every byte, so that mark, length, checksums and body are each hit.
    for at in damaged.offset..damaged.offset + damaged.stored_bytes() {
        let mut bytes = content.clone();
        bytes[at as usize] ^= 0x10;
        fs::write(&path, &bytes).unwrap();
        let (_, seqs, recovery) = open(folder.path());
        assert_eq!(seqs, [0, 2, 3, 4], "byte {at}");
        assert_eq!(recovery.torn_bytes, 0);
        assert_eq!(recovery.quarantined.len(), 1);
        assert_eq!(recovery.quarantined[0].segment, path);
        assert_eq!(recovery.quarantined[0].offset, damaged.offset);
        assert_eq!(recovery.quarantined[0].bytes, damaged.stored_bytes());
        assert_eq!(fs::read(&path).unwrap(), bytes, "the evidence stays");
    }
}

#[test]
fn the_end_of_a_closed_segment_is_quarantined_not_cut() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = SegmentLog::open(folder.path(), 1).unwrap();
    append(&mut log, 0..2);
    append(&mut log, 2..4);
    log.sync().unwrap();
    drop(log);
    let path = segment_path(folder.path(), 1);
    let mut content = fs::read(&path).unwrap();
    content.truncate(content.len() - 1);
    fs::write(&path, &content).unwrap();
    let (_, seqs, recovery) = open(folder.path());
    assert_eq!(seqs, [0, 2, 3]);
    assert_eq!(recovery.torn_bytes, 0);
    assert_eq!(recovery.quarantined.len(), 1);
    assert_eq!(fs::read(&path).unwrap(), content);
}

#[test]
fn a_segment_that_was_never_begun_is_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = SegmentLog::open(folder.path(), 1 << 20).unwrap();
    append(&mut log, 0..2);
    log.sync().unwrap();
    drop(log);
    fs::write(segment_path(folder.path(), 2), [0xd5, b'I']).unwrap();
    let (mut log, seqs, recovery) = open(folder.path());
    assert_eq!(seqs, [0, 1]);
    assert_eq!(recovery.torn_bytes, 2);
    assert!(!segment_path(folder.path(), 2).exists());
    append(&mut log, 2..3);
    log.sync().unwrap();
    drop(log);
    assert_eq!(open(folder.path()).1, [0, 1, 2]);
}

#[test]
fn a_read_finds_damage_and_outlives_deletion() {
    let folder = tempfile::tempdir().unwrap();
    let (mut log, _) = SegmentLog::open(folder.path(), 1).unwrap();
    let first = append(&mut log, 0..1).remove(0);
    append(&mut log, 1..2);
    log.sync().unwrap();
    assert_eq!(log.delete_segments(|_| false).unwrap(), 1);
    assert!(!segment_path(folder.path(), 1).exists());
    assert_eq!(first.read().unwrap(), chunk(0));
    let newest = append(&mut log, 2..3).remove(0);
    let path = segment_path(folder.path(), newest.segment());
    let mut content = fs::read(&path).unwrap();
    *content.last_mut().unwrap() ^= 1;
    fs::write(&path, content).unwrap();
    let error = newest.read().unwrap_err();
    assert!(matches!(error, ReplayError::Damaged { .. }), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn no_bytes_make_opening_panic(content in prop::collection::vec(any::<u8>(), 0..400)) {
        let folder = tempfile::tempdir().unwrap();
        fs::write(segment_path(folder.path(), 1), &content).unwrap();
        fs::write(segment_path(folder.path(), 2), &content).unwrap();
        let (mut log, seqs, recovery) = open(folder.path());
        prop_assert!(seqs.is_empty());
        prop_assert_eq!(recovery.torn_bytes, content.len() as u64);
        append(&mut log, 0..1);
        log.sync().unwrap();
        drop(log);
        prop_assert_eq!(open(folder.path()).1, [0]);
    }

    #[test]
    fn damage_anywhere_never_panics_and_never_invents(flips in prop::collection::vec((0.0..1.0_f64, any::<u8>()), 1..6)) {
        let folder = tempfile::tempdir().unwrap();
        let (mut log, _) = SegmentLog::open(folder.path(), 1 << 20).unwrap();
        for group in 0..4 {
            append(&mut log, group * 3..group * 3 + 3);
            log.sync().unwrap();
        }
        drop(log);
        let path = segment_path(folder.path(), 1);
        let mut content = fs::read(&path).unwrap();
        for (at, value) in flips {
            let at = (content.len() as f64 * at) as usize;
            content[at] = value;
        }
        fs::write(&path, content).unwrap();
        // `open` itself compares every chunk it meets with the one that was written.
        let (_, seqs, _) = open(folder.path());
        prop_assert!(seqs.is_sorted());
    }
}
