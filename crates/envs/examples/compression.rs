//! How well and how fast frames of the environments compress: the measurements behind the codec of
//! `isodream_core::codec`.
//!
//! `cargo run --release -p isodream-envs --example compression -- [frames per block,...] [id ...]`
//!
//! A transform makes blocks of frames easier to compress, a compressor packs each block by itself. MB are of raw
//! frames and all times are of one thread. `cost` is what one raw GB costs in seconds of that machine's parts when
//! each step is written once and read [`READS`] times: encoding, storing at [`DISK_MB_PER_S`], and per read the wire at
//! [`WIRE_MB_PER_S`] and decoding.

#![allow(clippy::print_stdout)]

use std::error::Error;
use std::hint::black_box;
use std::time::Instant;

use isodream_core::config::EnvConfig;
use isodream_envs::make;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const READS: f64 = 10.0;
const DISK_MB_PER_S: f64 = 1000.0;
const WIRE_MB_PER_S: f64 = 2000.0;
const FRAMES: usize = 1000;
const REPEATS: usize = 3;

const IDS: [&str; 5] = [
    "highway/day",
    "highway/night",
    "dmc/walker_walk",
    "dmc/cheetah_run/video_hard",
    "noise",
];

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let sizes = arguments.next().unwrap_or_else(|| "4".to_owned());
    let sizes: Vec<usize> = sizes.split(',').map(str::parse).collect::<Result<_, _>>()?;
    let mut ids: Vec<String> = arguments.collect();
    if ids.is_empty() {
        ids = IDS.map(String::from).into();
    }
    for id in ids {
        let frames = frames(&id)?;
        let bytes = frames[0].len();
        let frames = frames.concat();
        println!("{id}");
        println!(
            "{:<10} {:<12} {:>5} {:>7} {:>12} {:>12} {:>6}",
            "transform", "compressor", "block", "ratio", "encode MB/s", "decode MB/s", "cost"
        );
        for &size in &sizes {
            for transform in Transform::ALL {
                for packer in PACKERS {
                    measure(&frames, bytes, size, transform, packer)?;
                }
            }
        }
    }
    Ok(())
}

/// Frames of one environment under a random driver that changes its mind every fifth step.
fn frames(id: &str) -> Result<Vec<Vec<u8>>, Box<dyn Error>> {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    if id == "noise" {
        let noise = |_| (0..64 * 64 * 3).map(|_| rng.random()).collect();
        return Ok((0..FRAMES).map(noise).collect());
    }
    let dmc = id.starts_with("dmc");
    let mut env = make(&EnvConfig {
        id: id.to_owned(),
        action_repeat: if dmc { 2 } else { 4 },
        time_limit: 500,
        ..EnvConfig::default()
    })?;
    let mut action = vec![0.0; env.spec().action_dim];
    let mut frames = Vec::new();
    let mut last = true;
    while frames.len() < FRAMES {
        let transition = if last {
            env.reset(frames.len() as u64)?
        } else {
            if frames.len() % 5 == 0 {
                action.fill_with(|| rng.random_range(-1.0..1.0));
            }
            env.step(&action)?
        };
        last = transition.is_last;
        frames.push(transition.image);
    }
    Ok(frames)
}

fn measure(
    frames: &[u8],
    bytes: usize,
    size: usize,
    transform: Transform,
    packer: &Packer,
) -> Result<(), Box<dyn Error>> {
    let mut packed = vec![0; 2 * size * bytes + 1024];
    let mut scratch = vec![0; size * bytes];
    let (mut encode, mut decode) = (f64::MAX, f64::MAX);
    let mut stored = 0;
    for _ in 0..REPEATS {
        let mut blocks = Vec::new();
        let begun = Instant::now();
        for block in frames.chunks(size * bytes) {
            let input = &mut scratch[..block.len()];
            let input = transform.apply(block, input, bytes);
            let length = (packer.pack)(input, &mut packed)?;
            blocks.push(packed[..length].to_vec());
        }
        encode = encode.min(begun.elapsed().as_secs_f64());
        stored = blocks.iter().map(Vec::len).sum();
        let mut out = vec![0; frames.len()];
        for _ in 0..REPEATS {
            let begun = Instant::now();
            for (block, out) in blocks.iter().zip(out.chunks_mut(size * bytes)) {
                (packer.unpack)(block, out)?;
                transform.undo(out, bytes);
            }
            decode = decode.min(begun.elapsed().as_secs_f64());
        }
        black_box(&out);
        if out != frames {
            return Err(format!("{} does not return what went in", packer.name).into());
        }
    }
    let raw = frames.len() as f64 / 1e6;
    let stored_mb = stored as f64 / 1e6;
    let wire = stored_mb / WIRE_MB_PER_S;
    let cost = encode + stored_mb / DISK_MB_PER_S + READS * (wire + decode);
    println!(
        "{:<10} {:<12} {size:>5} {:>7.2} {:>12.0} {:>12.0} {:>6.2}",
        transform.name(),
        packer.name,
        raw / stored_mb,
        raw / encode,
        raw / decode,
        1e3 * cost / raw
    );
    Ok(())
}

#[derive(Clone, Copy)]
enum Transform {
    /// Frames as they are.
    None,
    /// All but a block's first frame XOR the frame before.
    Xor,
    /// All but a block's first frame minus the frame before.
    Sub,
    /// Frames channel by channel, then as [`Transform::Xor`].
    PlanarXor,
    /// The first frame minus its left neighbours, the others as [`Transform::Xor`].
    LeftXor,
}

impl Transform {
    const ALL: [Self; 5] = [
        Self::None,
        Self::Xor,
        Self::Sub,
        Self::PlanarXor,
        Self::LeftXor,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Xor => "xor",
            Self::Sub => "sub",
            Self::PlanarXor => "planar xor",
            Self::LeftXor => "left xor",
        }
    }

    fn apply<'a>(self, block: &'a [u8], out: &'a mut [u8], bytes: usize) -> &'a [u8] {
        if matches!(self, Self::None) {
            return block;
        }
        let (first, rest) = out.split_at_mut(bytes);
        if matches!(self, Self::LeftXor) {
            first[..3].copy_from_slice(&block[..3]);
            for ((o, now), before) in first[3..].iter_mut().zip(&block[3..]).zip(block) {
                *o = now.wrapping_sub(*before);
            }
        } else {
            first.copy_from_slice(&block[..bytes]);
        }
        let pairs = rest.iter_mut().zip(block[bytes..].iter().zip(block));
        if matches!(self, Self::Sub) {
            pairs.for_each(|(out, (now, before))| *out = now.wrapping_sub(*before));
        } else {
            pairs.for_each(|(out, (now, before))| *out = now ^ before);
        }
        if matches!(self, Self::PlanarXor) {
            for frame in out.chunks_mut(bytes) {
                let pixels = frame.to_vec();
                let plane = bytes / 3;
                for (index, pixel) in pixels.chunks_exact(3).enumerate() {
                    frame[index] = pixel[0];
                    frame[plane + index] = pixel[1];
                    frame[2 * plane + index] = pixel[2];
                }
            }
        }
        out
    }

    fn undo(self, block: &mut [u8], bytes: usize) {
        if matches!(self, Self::None) {
            return;
        }
        if matches!(self, Self::PlanarXor) {
            for frame in block.chunks_mut(bytes) {
                let planes = frame.to_vec();
                let plane = bytes / 3;
                for (index, pixel) in frame.chunks_exact_mut(3).enumerate() {
                    pixel.copy_from_slice(&[
                        planes[index],
                        planes[plane + index],
                        planes[2 * plane + index],
                    ]);
                }
            }
        }
        if matches!(self, Self::LeftXor) {
            let mut left = [0_u8; 3];
            for pixel in block[..bytes].chunks_exact_mut(3) {
                for (value, left) in pixel.iter_mut().zip(&mut left) {
                    *left = left.wrapping_add(*value);
                    *value = *left;
                }
            }
        }
        for end in (2 * bytes..=block.len()).step_by(bytes) {
            let (before, now) = block[end - 2 * bytes..end].split_at_mut(bytes);
            match self {
                Self::Sub => {
                    for (now, before) in now.iter_mut().zip(before) {
                        *now = now.wrapping_add(*before);
                    }
                }
                _ => {
                    for (now, before) in now.iter_mut().zip(before) {
                        *now ^= *before;
                    }
                }
            }
        }
    }
}

type Pack = fn(&[u8], &mut [u8]) -> Result<usize, Box<dyn Error>>;
type Unpack = fn(&[u8], &mut [u8]) -> Result<(), Box<dyn Error>>;

struct Packer {
    name: &'static str,
    pack: Pack,
    unpack: Unpack,
}

/// Higher acceleration searches less.
fn lz4_pack(acceleration: i32, block: &[u8], out: &mut [u8]) -> Result<usize, Box<dyn Error>> {
    let mode = Some(lz4::block::CompressionMode::FAST(acceleration));
    Ok(lz4::block::compress_to_buffer(block, mode, false, out)?)
}

fn lz4_unpack(block: &[u8], out: &mut [u8]) -> Result<(), Box<dyn Error>> {
    lz4::block::decompress_to_buffer(block, Some(out.len() as i32), out)?;
    Ok(())
}

fn zstd_pack(level: i32, block: &[u8], out: &mut [u8]) -> Result<usize, Box<dyn Error>> {
    thread_local!(static CONTEXT: std::cell::RefCell<zstd::bulk::Compressor<'static>> = Default::default());
    CONTEXT.with_borrow_mut(|context| {
        context.set_compression_level(level)?;
        Ok(context.compress_to_buffer(block, out)?)
    })
}

fn zstd_unpack(block: &[u8], out: &mut [u8]) -> Result<(), Box<dyn Error>> {
    thread_local!(static CONTEXT: std::cell::RefCell<zstd::bulk::Decompressor<'static>> = Default::default());
    CONTEXT.with_borrow_mut(|context| context.decompress_to_buffer(block, out))?;
    Ok(())
}

const PACKERS: &[Packer] = &[
    Packer {
        name: "raw",
        pack: |block, out| {
            out[..block.len()].copy_from_slice(block);
            Ok(block.len())
        },
        unpack: |block, out| {
            out.copy_from_slice(block);
            Ok(())
        },
    },
    Packer {
        name: "lz4_flex",
        pack: |block, out| Ok(lz4_flex::block::compress_into(block, out)?),
        unpack: |block, out| {
            lz4_flex::block::decompress_into(block, out)?;
            Ok(())
        },
    },
    Packer {
        name: "lz4 C 1",
        pack: |block, out| lz4_pack(1, block, out),
        unpack: lz4_unpack,
    },
    Packer {
        name: "lz4 C 4",
        pack: |block, out| lz4_pack(4, block, out),
        unpack: lz4_unpack,
    },
    Packer {
        name: "lz4 C 8",
        pack: |block, out| lz4_pack(8, block, out),
        unpack: lz4_unpack,
    },
    Packer {
        name: "lz4 C 16",
        pack: |block, out| lz4_pack(16, block, out),
        unpack: lz4_unpack,
    },
    Packer {
        name: "zstd -5",
        pack: |block, out| zstd_pack(-5, block, out),
        unpack: zstd_unpack,
    },
    Packer {
        name: "zstd -1",
        pack: |block, out| zstd_pack(-1, block, out),
        unpack: zstd_unpack,
    },
    Packer {
        name: "zstd 1",
        pack: |block, out| zstd_pack(1, block, out),
        unpack: zstd_unpack,
    },
    Packer {
        name: "zstd 3",
        pack: |block, out| zstd_pack(3, block, out),
        unpack: zstd_unpack,
    },
];
