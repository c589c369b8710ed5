//! `isodream doctor`: whether this machine has what a run needs, and what to do where it has not.

use std::fs::File;
use std::io::Write;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::bail;
use clap::Args;
use isodream_core::config::EnvConfig;
use isodream_envs::make;
use rustix::process::{Resource, getrlimit};

use crate::output::print;

/// Where roles listen unless they are told otherwise.
const PORTS: [(u16, &str); 3] = [
    (7001, "replay-server"),
    (7002, "learner"),
    (7080, "dashboard"),
];

/// Memory below which the quick preset has no room.
const LEAST_MEMORY_GB: f64 = 4.0;

/// Room on the disk below which a run does not get far.
const LEAST_DISK_GB: f64 = 5.0;

/// An acknowledgement waits for one sync: slower ones hold actors up.
const SLOW_SYNC: Duration = Duration::from_millis(50);

/// Files and connections of a replay-server with a few actors.
const LEAST_FILES: u64 = 1024;

/// Options of `isodream doctor`.
#[derive(Debug, Args)]
pub(crate) struct DoctorArgs {
    /// Where runs will lie
    #[arg(long, default_value = ".")]
    dir: PathBuf,
}

/// What was found of one thing.
enum Finding {
    Good(String),
    /// It works, but.
    Poor(String, &'static str),
    /// It does not.
    Bad(String, &'static str),
}

use Finding::{Bad, Good, Poor};

/// Runs the command, and fails where something is missing that a run needs.
pub(crate) fn run(args: &DoctorArgs) -> anyhow::Result<()> {
    let findings = [
        ("processor", processor()),
        ("memory", memory()),
        ("disk", disk(&args.dir)),
        ("open files", files()),
        #[cfg(feature = "torch")]
        ("libtorch", torch()),
        (
            "highway",
            world("highway/day", "this is a defect: please report it"),
        ),
        #[cfg(feature = "mujoco")]
        (
            "MuJoCo",
            world(
                "dmc/walker_walk/video_easy",
                "cargo xtask setup puts MuJoCo and the models into .native",
            ),
        ),
        ("ports", ports()),
    ];
    let mut bad = 0;
    for (thing, finding) in &findings {
        let (mark, words, cure) = match finding {
            Good(words) => ("ok  ", words, None),
            Poor(words, cure) => ("poor", words, Some(cure)),
            Bad(words, cure) => {
                bad += 1;
                ("BAD ", words, Some(cure))
            }
        };
        print(&format!("{mark}  {thing:<11} {words}"))?;
        if let Some(cure) = cure {
            print(&format!("      {:<11} {cure}", ""))?;
        }
    }
    if bad > 0 {
        bail!(
            "{bad} of {} things have to be put right before a run",
            findings.len()
        );
    }
    Ok(())
}

fn processor() -> Finding {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let features = features();
    let words = format!(
        "{cores} cores, {}",
        if features.is_empty() {
            "no wide vectors".into()
        } else {
            features.join(" ")
        }
    );
    match cores {
        1 => Poor(
            words,
            "a learner and its actors share the core: expect a few updates per second",
        ),
        _ => Good(words),
    }
}

/// Instructions that libtorch has use for.
fn features() -> Vec<&'static str> {
    #[cfg(target_arch = "x86_64")]
    {
        let all = [
            ("avx2", std::arch::is_x86_feature_detected!("avx2")),
            ("avx512f", std::arch::is_x86_feature_detected!("avx512f")),
            (
                "avx512bf16",
                std::arch::is_x86_feature_detected!("avx512bf16"),
            ),
        ];
        all.into_iter()
            .filter(|(_, has)| *has)
            .map(|(name, _)| name)
            .collect()
    }
    #[cfg(not(target_arch = "x86_64"))]
    Vec::new()
}

fn memory() -> Finding {
    let info = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let gb = |key: &str| {
        let line = info.lines().find_map(|line| line.strip_prefix(key))?;
        let kib: f64 = line.split_whitespace().next()?.parse().ok()?;
        Some(kib * 1024.0 / 1e9)
    };
    let (Some(total), Some(free)) = (gb("MemTotal:"), gb("MemAvailable:")) else {
        return Poor("unknown".into(), "no /proc/meminfo on this system");
    };
    let words = format!("{free:.1} of {total:.1} GB available");
    if free < LEAST_MEMORY_GB {
        return Poor(
            words,
            "the quick preset wants 4 GB, the paper's sizes 12 GB: close something, or lower learner.batch_size",
        );
    }
    Good(words)
}

fn disk(dir: &Path) -> Finding {
    let Ok(room) = rustix::fs::statvfs(dir) else {
        return Bad(
            format!("{} cannot be looked at", dir.display()),
            "give a folder that exists: --dir",
        );
    };
    let gb = room.f_bavail as f64 * room.f_frsize as f64 / 1e9;
    let sync = match sync_time(dir) {
        Ok(sync) => sync,
        Err(error) => {
            return Bad(
                format!("{}: {error}", dir.display()),
                "choose a folder that can be written to: --dir",
            );
        }
    };
    let words = format!(
        "{gb:.0} GB free, {:.1} ms per sync",
        1e3 * sync.as_secs_f64()
    );
    if gb < LEAST_DISK_GB {
        return Poor(
            words,
            "500,000 frames take some 10 GB: free space, or bound it with replay.capacity_mb",
        );
    }
    if sync > SLOW_SYNC {
        return Poor(
            words,
            "acknowledgements wait for syncs: put the replay folder on a faster disk",
        );
    }
    Good(words)
}

/// Median of some syncs of a small file.
fn sync_time(dir: &Path) -> std::io::Result<Duration> {
    let path = dir.join(format!(".isodream-doctor-{}", std::process::id()));
    let measure = || {
        let mut file = File::create(&path)?;
        let mut times = Vec::new();
        for _ in 0..7 {
            file.write_all(&[0; 65_536])?;
            let begun = Instant::now();
            file.sync_data()?;
            times.push(begun.elapsed());
        }
        times.sort();
        Ok(times[times.len() / 2])
    };
    let measured = measure();
    let _ = std::fs::remove_file(&path);
    measured
}

fn files() -> Finding {
    let limit = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
    let words = format!("{limit} at most");
    if limit < LEAST_FILES {
        return Poor(
            words,
            "raise it (ulimit -n 65536) before many actors connect",
        );
    }
    Good(words)
}

#[cfg(feature = "torch")]
fn torch() -> Finding {
    let device = if tch::Cuda::is_available() {
        format!("{} CUDA devices", tch::Cuda::device_count())
    } else {
        "no CUDA device".to_owned()
    };
    // Wrong libraries are found out by using them.
    let product = tch::Tensor::ones([64, 64], (tch::Kind::Float, tch::Device::Cpu));
    let sum = product
        .matmul(&product)
        .sum(tch::Kind::Float)
        .double_value(&[]);
    if sum != 64.0 * 64.0 * 64.0 {
        return Bad(
            format!("a product came out as {sum}"),
            "cargo xtask setup --verify checks the library's files",
        );
    }
    Good(format!("multiplies; {device}"))
}

fn world(id: &str, cure: &'static str) -> Finding {
    let config = EnvConfig {
        id: id.to_owned(),
        ..EnvConfig::default()
    };
    let begun = Instant::now();
    match make(&config).and_then(|mut env| env.reset(1)) {
        Ok(_) => Good(format!(
            "{id} shows a picture in {:.2} s",
            begun.elapsed().as_secs_f64()
        )),
        Err(error) => Bad(format!("{id}: {error}"), cure),
    }
}

fn ports() -> Finding {
    let taken = |port: u16| TcpListener::bind(("127.0.0.1", port)).is_err();
    let taken: Vec<String> = PORTS
        .iter()
        .filter(|(port, _)| taken(*port))
        .map(|(port, role)| format!("{port} ({role})"))
        .collect();
    if taken.is_empty() {
        return Good("the usual ones are free".into());
    }
    Poor(
        format!("taken: {}", taken.join(", ")),
        "isodream train takes others by itself; roles by hand want --listen",
    )
}
