#![allow(clippy::unwrap_used)]

use proptest::prelude::*;

use super::*;

fn chunks() -> impl Strategy<Value = Chunk> {
    (
        "[a-zé0-9-]{1,40}",
        any::<(u64, u64, u64)>(),
        0..u32::MAX / 2,
        1..1000_u32,
        any::<bool>(),
        prop::collection::vec(any::<u8>(), 0..120),
    )
        .prop_map(
            |(actor_id, (epoch, seq, episode_id), first_step, steps, ends_episode, payload)| {
                Chunk {
                    actor_id,
                    epoch,
                    seq,
                    episode_id,
                    first_step,
                    steps,
                    ends_episode,
                    payload: payload.into(),
                }
            },
        )
}

fn records() -> impl Strategy<Value = Record> {
    let progress =
        ("[a-z]{1,20}", any::<(u64, u64)>()).prop_map(|(actor_id, (epoch, next_seq))| Progress {
            actor_id,
            epoch,
            next_seq,
        });
    prop_oneof![
        4 => chunks().prop_map(Record::Chunk),
        1 => progress.clone().prop_map(Record::Progress),
        1 => (any::<(u64, u64, u64)>(), prop::collection::vec(progress, 0..5)).prop_map(|((inserted_steps, segment, offset), progress)| {
            Record::Snapshot(Snapshot { inserted_steps, closed: LogPosition { segment, offset }, progress })
        }),
    ]
}

fn frame(record: &Record, commit_start: u64) -> Vec<u8> {
    let mut out = Vec::new();
    assert_eq!(encode(record, commit_start, &mut out), out.len());
    out
}

fn decode_all(bytes: &[u8]) -> Result<(u64, Record), &'static str> {
    let header = decode_header(bytes)?;
    let payload = bytes.get(header.header_bytes..).unwrap_or_default();
    header.check_payload(payload)?;
    let commit_start = header.commit_start;
    let record = match header.entry(payload)? {
        Entry::Chunk(_) => Record::Chunk(decode_chunk(&Bytes::copy_from_slice(bytes))?),
        Entry::Snapshot(snapshot) => Record::Snapshot(snapshot),
        Entry::Progress(progress) => Record::Progress(progress),
    };
    Ok((commit_start, record))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn decoding_returns_what_was_encoded(record in records(), commit_start in any::<u64>()) {
        prop_assert_eq!(decode_all(&frame(&record, commit_start)), Ok((commit_start, record)));
    }

    #[test]
    fn every_truncation_is_an_error(record in records()) {
        let bytes = frame(&record, 7);
        for end in 0..bytes.len() {
            prop_assert!(decode_all(&bytes[..end]).is_err(), "cut to {end} bytes");
        }
    }

    #[test]
    fn every_bit_flip_is_an_error(record in records()) {
        let bytes = frame(&record, 7);
        for bit in 0..bytes.len() * 8 {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            prop_assert!(decode_all(&flipped).is_err(), "bit {bit}");
        }
    }

    #[test]
    fn a_header_alone_tells_all_but_the_payload(chunk in chunks()) {
        let bytes = frame(&Record::Chunk(chunk.clone()), 7);
        let header = decode_header(&bytes[..bytes.len() - chunk.payload.len()]).unwrap();
        prop_assert_eq!(header.frame_bytes(), bytes.len());
        prop_assert_eq!(header.check_payload(&chunk.payload), Ok(()));
        prop_assert_eq!(decode_chunk(&bytes.into()), Ok(chunk));
    }

    #[test]
    fn arbitrary_metadata_and_payloads_with_valid_checksums_never_panic(
        meta in prop::collection::vec(any::<u8>(), 0..100),
        payload in prop::collection::vec(any::<u8>(), 0..100),
    ) {
        let mut header = vec![0; FIXED_BYTES];
        header[..4].copy_from_slice(&MAGIC);
        header[4..6].copy_from_slice(&(meta.len() as u16).to_le_bytes());
        header[6..10].copy_from_slice(&(payload.len() as u32).to_le_bytes());
        header[18..22].copy_from_slice(&crc32c::crc32c(&payload).to_le_bytes());
        header.extend_from_slice(&meta);
        let crc = header_crc(&header);
        header[CRC_AT..FIXED_BYTES].copy_from_slice(&crc.to_le_bytes());
        if let Ok(header) = decode_header(&header) {
            let _ = header.entry(&payload);
        }
    }
}

#[test]
fn what_the_format_cannot_hold_is_refused_by_name() {
    let good = Chunk {
        actor_id: "actor-3".into(),
        epoch: 1,
        seq: 9,
        episode_id: 0,
        first_step: 0,
        steps: 1,
        ends_episode: false,
        payload: Bytes::new(),
    };
    check(&good).unwrap();
    let long_id = Chunk {
        actor_id: "x".repeat(256),
        ..good.clone()
    };
    let empty = Chunk {
        steps: 0,
        ..good.clone()
    };
    let overflow = Chunk {
        first_step: u32::MAX,
        ..good.clone()
    };
    let huge = Chunk {
        payload: vec![0; MAX_PAYLOAD_BYTES + 1].into(),
        ..good
    };
    for bad in [long_id, empty, overflow, huge] {
        let error = check(&bad).unwrap_err().to_string();
        assert!(error.starts_with("chunk 9 of `"), "{error}");
    }
}
