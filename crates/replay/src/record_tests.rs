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
        1 => (any::<u64>(), prop::collection::vec(progress, 0..5)).prop_map(|(inserted_steps, progress)| {
            Record::Snapshot(Snapshot { inserted_steps, progress })
        }),
    ]
}

fn frame(record: &Record, commit_start: u64) -> Vec<u8> {
    let mut out = Vec::new();
    assert_eq!(encode(record, commit_start, &mut out), out.len());
    out
}

fn decode(bytes: &[u8]) -> Result<(u64, Record), &'static str> {
    let header = decode_header(bytes)?;
    let body = bytes
        .get(HEADER_BYTES..HEADER_BYTES + header.body_bytes)
        .ok_or("cut off")?;
    Ok((
        header.commit_start,
        decode_body(&header, &Bytes::copy_from_slice(body))?,
    ))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn decoding_returns_what_was_encoded(record in records(), commit_start in any::<u64>()) {
        prop_assert_eq!(decode(&frame(&record, commit_start)), Ok((commit_start, record)));
    }

    #[test]
    fn every_truncation_is_an_error(record in records()) {
        let bytes = frame(&record, 7);
        for end in 0..bytes.len() {
            prop_assert!(decode(&bytes[..end]).is_err(), "cut to {end} bytes");
        }
    }

    #[test]
    fn every_bit_flip_is_an_error(record in records()) {
        let bytes = frame(&record, 7);
        for bit in 0..bytes.len() * 8 {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            prop_assert!(decode(&flipped).is_err(), "bit {bit}");
        }
    }

    #[test]
    fn arbitrary_bodies_with_valid_checksums_never_panic(body in prop::collection::vec(any::<u8>(), 0..100)) {
        let header = Header {
            body_bytes: body.len(),
            commit_start: 0,
            body_crc: crc32c::crc32c(&body),
        };
        let _ = decode_body(&header, &body.into());
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
