//! Every decoder of bytes that come from outside, fed with damaged bytes: none may panic, hang, or take more
//! memory than its cap.
//!
//! Inputs are valid ones and the files in `corpus/TARGET/`, which keeps what once broke a decoder, as they are
//! and with random damage. A plain test run makes a fixed number of inputs from a fixed seed;
//! `cargo xtask fuzz --seconds N` goes on for that long with another seed each time.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod damage;
mod targets;

use std::panic::AssertUnwindSafe;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Inputs of a plain test run.
const INPUTS: u64 = 3_000;
/// The same where each is synced to disk.
const SYNCED_INPUTS: u64 = 300;

fn corpus(target: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/fuzz/corpus")
        .join(target);
    let Ok(entries) = std::fs::read_dir(folder) else {
        return Vec::new();
    };
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
        .iter()
        .map(|file| std::fs::read(file).unwrap())
        .collect()
}

/// Runs `target` over `valid` inputs, the corpus, and damaged ones of both.
fn fuzz(name: &str, input_count: u64, valid: Vec<Vec<u8>>, target: impl Fn(&[u8])) {
    let seconds = std::env::var("ISODREAM_FUZZ_SECONDS").ok();
    let seconds: Option<u64> = seconds.map(|seconds| seconds.parse().unwrap());
    let seed = match seconds {
        Some(_) => rand::random(),
        None => 1,
    };
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let inputs: Vec<Vec<u8>> = valid.into_iter().chain(corpus(name)).collect();
    for input in &inputs {
        target(input);
    }
    let since = Instant::now();
    let mut count = 0;
    while match seconds {
        Some(seconds) => since.elapsed() < Duration::from_secs(seconds),
        None => count < input_count,
    } {
        let input = damage::damaged(&inputs[rng.random_range(0..inputs.len())], &mut rng);
        if let Err(panic) = std::panic::catch_unwind(AssertUnwindSafe(|| target(&input))) {
            let file = std::env::temp_dir().join(format!("isodream-fuzz-{name}-{seed}-{count}"));
            std::fs::write(&file, &input).unwrap();
            println!(
                "seed {seed}, input {count}: keep {} in tests/fuzz/corpus/{name}",
                file.display()
            );
            std::panic::resume_unwind(panic);
        }
        count += 1;
    }
    println!("{name}: {count} inputs");
}

#[test]
fn payloads_of_steps() {
    fuzz(
        "payload",
        INPUTS,
        targets::payloads(),
        targets::decode_payload,
    );
}

#[test]
fn messages_of_replay() {
    fuzz(
        "message",
        INPUTS,
        targets::messages(),
        targets::decode_message,
    );
}

#[test]
fn segments_of_a_store() {
    fuzz(
        "segment",
        SYNCED_INPUTS,
        targets::segments(),
        targets::open_segment,
    );
}
