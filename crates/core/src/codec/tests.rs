//! Whatever was encoded comes back, whole and in parts; whatever else comes is an error and no panic.

use proptest::prelude::*;

use super::*;
use crate::Step;

/// Large enough that a payload has several blocks.
const IMAGE_BYTES: usize = BLOCK_BYTES / 3;

/// Steps with images that compress, and some that do not.
fn steps(image_bytes: usize, len: std::ops::Range<usize>) -> impl Strategy<Value = Steps> {
    let step = (
        any::<(u8, bool)>(),
        prop::collection::vec(-1.0_f32..1.0, 2),
        -10.0_f32..10.0,
        any::<(bool, bool, bool)>(),
    )
        .prop_map(
            move |((seed, noisy), action, reward, (is_first, is_last, is_terminal))| Step {
                image: image(image_bytes, seed, noisy),
                action,
                reward,
                discount: f32::from(u8::from(!is_terminal)),
                is_first,
                is_last,
                is_terminal,
            },
        );
    prop::collection::vec(step, len).prop_map(move |rows| {
        let mut steps = Steps::new(image_bytes, 2);
        for row in &rows {
            steps.push(row);
        }
        steps
    })
}

fn image(bytes: usize, seed: u8, noisy: bool) -> Vec<u8> {
    if !noisy {
        return (0..bytes)
            .map(|i| seed.wrapping_add((i / 50) as u8))
            .collect();
    }
    let mut state = 0x9e37_79b9_7f4a_7c15 ^ u64::from(seed);
    let noise = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 32) as u8
    };
    std::iter::repeat_with(noise).take(bytes).collect()
}

/// The steps `range`, through a decoder that has just decoded something else.
fn part(payload: &[u8], range: std::ops::Range<usize>) -> Result<Steps, DecodeError> {
    let payload = Payload::parse(payload)?;
    let mut part = Steps::new(payload.image_bytes(), payload.action_dim());
    part.len = range.len();
    part.images = vec![1; range.len() * part.image_bytes];
    part.actions = vec![1.0; range.len() * part.action_dim];
    part.rewards = vec![1.0; range.len()];
    part.discounts = vec![1.0; range.len()];
    let rows = Rows {
        images: &mut part.images,
        actions: &mut part.actions,
        rewards: &mut part.rewards,
        discounts: &mut part.discounts,
    };
    let mut decoder = Decoder {
        block: vec![7; 100],
    };
    decoder.decode_into(&payload, range.clone(), rows)?;
    part.flags = payload.flags()[range].to_vec();
    Ok(part)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn decoding_returns_what_was_encoded(
        steps in prop_oneof![steps(27, 0..20), steps(IMAGE_BYTES, 0..12), steps(0, 0..3), steps(2 * BLOCK_BYTES, 0..3)],
    ) {
        prop_assert_eq!(decode(&encode(&steps)), Ok(steps));
    }

    #[test]
    fn every_part_is_cut_out_of_the_whole(steps in steps(IMAGE_BYTES, 1..12), cut in (0.0_f64..1.0, 0.0_f64..1.0)) {
        let payload = encode(&steps);
        let start = (cut.0 * steps.len as f64) as usize;
        let end = start + (cut.1 * (steps.len - start + 1) as f64) as usize;
        let mut expected = Steps::new(steps.image_bytes, steps.action_dim);
        expected.extend(&steps, start..end);
        prop_assert_eq!(part(&payload, start..end), Ok(expected));
        let beyond = part(&payload, start..steps.len + 1);
        prop_assert_eq!(beyond, Err(DecodeError::OutOfRange { end: steps.len + 1, steps: steps.len }));
    }

    #[test]
    fn truncation_and_surplus_are_errors(steps in steps(IMAGE_BYTES, 0..8), cut in 0.0_f64..1.0) {
        let payload = encode(&steps);
        let kept = (payload.len() as f64 * cut) as usize;
        let truncated = matches!(decode(&payload[..kept]), Err(DecodeError::Truncated { .. }));
        prop_assert!(truncated);
        let longer = [&payload[..], &[0; 3]].concat();
        prop_assert_eq!(decode(&longer), Err(DecodeError::Surplus { bytes: 3 }));
    }

    #[test]
    fn flipped_bits_never_panic_nor_overrun(
        steps in steps(IMAGE_BYTES, 1..8),
        flips in prop::collection::vec((0.0_f64..1.0, 0_u8..8), 1..4),
        in_sizes in any::<bool>(),
    ) {
        let mut payload = encode(&steps).to_vec();
        let reach = if in_sizes { HEADER_BYTES } else { payload.len() };
        for (place, bit) in flips {
            payload[(place * reach as f64) as usize] ^= 1 << bit;
        }
        if let Ok(decoded) = decode(&payload) {
            prop_assert_eq!(decoded.images.len(), decoded.len * decoded.image_bytes);
        }
    }

    #[test]
    fn arbitrary_bytes_never_panic(
        sizes in prop::collection::vec(0_u32..40, 4),
        bytes in prop::collection::vec(any::<u8>(), 0..400),
    ) {
        let _ = decode(&bytes);
        let header: Vec<u8> = sizes.iter().flat_map(|size| size.to_le_bytes()).collect();
        let _ = decode(&[header, bytes].concat());
    }
}

#[test]
fn a_bomb_is_refused_before_memory_is_taken() {
    for sizes in [
        [u32::MAX, u32::MAX, 2, 1],
        [u32::MAX, 0, 0, 1],
        [1, u32::MAX, 0, 1],
        [1 << 16, 1 << 10, 1, u32::MAX],
    ] {
        let payload: Vec<u8> = sizes.iter().flat_map(|size| size.to_le_bytes()).collect();
        assert!(
            matches!(decode(&payload), Err(DecodeError::TooLarge { .. })),
            "{sizes:?}"
        );
    }
    let payload: Vec<u8> = [1_u32, 4, 0, 0]
        .iter()
        .flat_map(|size| size.to_le_bytes())
        .collect();
    assert_eq!(decode(&payload), Err(DecodeError::EmptyBlocks));
}

#[test]
fn noise_is_stored_as_it_is_and_what_compresses_is_smaller() {
    let one = |noisy| {
        let mut steps = Steps::new(IMAGE_BYTES, 0);
        steps.push(&Step {
            image: image(IMAGE_BYTES, 3, noisy),
            action: Vec::new(),
            reward: 0.0,
            discount: 1.0,
            is_first: true,
            is_last: false,
            is_terminal: false,
        });
        encode(&steps).len()
    };
    assert_eq!(one(true), HEADER_BYTES + 9 + 4 + IMAGE_BYTES);
    assert!(one(false) < IMAGE_BYTES / 10);
}

#[test]
fn blocks_are_spread_evenly() {
    let frame = 64 * 64 * 3;
    assert_eq!(
        [1, 8, 16, 25, 50].map(|steps| block_steps(steps, frame)),
        [1, 8, 8, 7, 8]
    );
    assert_eq!(block_steps(5, 1 << 20), 1);
    assert_eq!((block_steps(0, 0), block_steps(5, 0)), (1, 5));
}

#[test]
fn blocks_that_hold_nothing_wanted_are_not_decoded() {
    let mut steps = Steps::new(BLOCK_BYTES, 0);
    for seed in 0..3 {
        steps.push(&Step {
            image: image(BLOCK_BYTES, seed, false),
            action: Vec::new(),
            reward: 0.0,
            discount: 1.0,
            is_first: false,
            is_last: false,
            is_terminal: false,
        });
    }
    let mut payload = encode(&steps).to_vec();
    // The last block's end.
    let end = payload.len();
    payload[end - 40..].fill(0xff);
    assert!(part(&payload, 0..2).is_ok());
    assert!(matches!(
        part(&payload, 1..3),
        Err(DecodeError::Images { block: 2, .. })
    ));
}
