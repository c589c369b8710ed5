use super::*;

fn chunk(seq: u64, episode_id: EpisodeId, first_step: u32) -> Chunk {
    Chunk {
        actor_id: "ledger-0".into(),
        epoch: 7,
        seq,
        episode_id,
        first_step,
        steps: 10,
        ends_episode: false,
        payload: vec![seq as u8; 20].into(),
    }
}

/// Five chunks of two episodes, the last one in another store, and what was acknowledged of them.
fn sound() -> (Vec<Entry>, Vec<(&'static str, Chunk)>) {
    let stored = vec![
        ("a", chunk(0, 1, 0)),
        ("a", chunk(1, 1, 10)),
        ("a", chunk(2, 2, 0)),
        ("a", chunk(3, 2, 10)),
        ("b", chunk(0, 2, 20)),
    ];
    let acknowledged = stored.iter().map(|(store, chunk)| Entry::new(store, chunk));
    (acknowledged.collect(), stored)
}

fn audit(acknowledged: &[Entry], chunks: &[(&str, Chunk)]) -> Audit {
    let mut stored = Stored::default();
    for (store, chunk) in chunks {
        stored.add(store, chunk);
    }
    Audit::of(acknowledged, &stored)
}

#[test]
fn what_is_whole_is_clean() {
    let (acknowledged, stored) = sound();
    let report = audit(&acknowledged, &stored);
    assert_eq!((report.acknowledged_steps, report.stored_steps), (50, 50));
    assert!(report.is_clean(), "{report:?}");
    let unacknowledged = audit(&acknowledged[..3], &stored);
    assert!(
        unacknowledged.is_clean(),
        "more than was promised is no fault"
    );
}

#[test]
fn a_lost_chunk_is_found_at_the_end_and_in_the_middle() {
    let (acknowledged, mut stored) = sound();
    stored.pop();
    let report = audit(&acknowledged, &stored);
    assert_eq!((report.lost_steps, report.missing_chunks), (10, 0));
    stored.remove(1);
    let report = audit(&acknowledged, &stored);
    assert_eq!((report.lost_steps, report.missing_chunks), (20, 1));
    assert!(!report.is_clean());
    let report = audit(&[], &stored);
    assert_eq!(
        (report.lost_steps, report.missing_chunks),
        (0, 1),
        "also of an actor without a ledger"
    );
}

#[test]
fn a_chunk_in_the_store_that_did_not_acknowledge_it_is_lost() {
    let (acknowledged, mut stored) = sound();
    stored[4].0 = "a";
    assert_eq!(audit(&acknowledged, &stored).lost_steps, 10);
}

#[test]
fn a_doubled_chunk_is_found_in_the_same_store_and_in_another() {
    for store in ["a", "b"] {
        let (acknowledged, mut stored) = sound();
        stored.push((store, chunk(9, 1, 10)));
        let report = audit(&acknowledged, &stored);
        assert_eq!(report.doubled_steps, 10, "{report:?}");
        assert!(!report.is_clean());
    }
    let (acknowledged, mut stored) = sound();
    stored.push(("b", chunk(1, 1, 5)));
    assert_eq!(audit(&acknowledged, &stored).doubled_steps, 10, "in parts");
}

#[test]
fn an_altered_chunk_is_found() {
    let (acknowledged, mut stored) = sound();
    stored[2].1.payload = vec![0xff; 20].into();
    let report = audit(&acknowledged, &stored);
    assert_eq!((report.altered_steps, report.lost_steps), (10, 0));
    let (acknowledged, mut stored) = sound();
    stored[2].1.steps = 9;
    assert_eq!(audit(&acknowledged, &stored).altered_steps, 10);
}

#[test]
fn a_ledger_is_read_back_but_for_a_line_that_was_cut() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("ledger");
    let (acknowledged, stored) = sound();
    {
        let file = LedgerFile::open(&path)?;
        for (store, chunk) in &stored {
            file.acknowledged(store, chunk);
        }
    }
    assert_eq!(read(&path)?, acknowledged);
    let text = fs::read_to_string(&path)?;
    fs::write(&path, &text[..text.len() - 3])?;
    assert_eq!(read(&path)?, acknowledged[..4]);
    fs::write(&path, text.replacen(' ', "_", 1))?;
    assert!(read(&path).is_err_and(|error| error.to_string().contains("line 1 of")));
    Ok(())
}
