//! `isodream bench replay`: insertion and sampling through a real replay-server, in processes of their own.

pub(super) mod part;
mod probes;
mod sampler;
mod server;
mod writer;

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use clap::Args;
use serde::Serialize;

pub(crate) use self::part::PartArgs;
pub(super) use self::part::run as run_part;
use self::part::{Done, Part, Role, Work};
use self::server::Usage;
use crate::output::print_result;

/// Options of `isodream bench replay`.
#[derive(Debug, Args)]
pub(crate) struct ReplayBenchArgs {
    /// Whose frames are stored; several are measured one after the other
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "highway/day,dmc/walker_walk"
    )]
    environments: Vec<String>,
    /// Different episodes, written again and again
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..))]
    episodes: u64,
    /// Steps per episode
    #[arg(long, default_value_t = 500, value_parser = clap::value_parser!(u16).range(1..))]
    episode_steps: u16,
    /// Height and width of a frame
    #[arg(long, default_value_t = 64)]
    image_size: usize,
    /// Numbers in an action
    #[arg(long, default_value_t = 6)]
    action_dim: usize,
    /// Steps per chunk
    #[arg(long, default_value_t = 16, value_parser = clap::value_parser!(u16).range(1..))]
    chunk_steps: u16,
    /// Sequences per batch
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u16).range(1..))]
    batch: u16,
    /// Steps per sequence
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u16).range(1..))]
    length: u16,
    /// Batches that the sampling client asks for ahead
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u16).range(1..))]
    prefetch_batches: u16,
    /// Threads that decode batches
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    decoders: u16,
    /// Chunks that the writer keeps until they are durable
    #[arg(long, default_value_t = 256, value_parser = clap::value_parser!(u16).range(1..))]
    spool_chunks: u16,
    /// Bytes after which a log segment is closed
    #[arg(long, default_value_t = 64 << 20)]
    segment_bytes: u64,
    /// Runs of everything; the best and the median count
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..))]
    runs: u16,
    /// Seconds of one measurement
    #[arg(long, default_value_t = 2.0)]
    seconds: f64,
    /// Folder for the experience, on the disk to be measured; it is emptied afterwards
    #[arg(long, default_value = "runs/bench-replay")]
    dir: PathBuf,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

/// The best and the median of some runs.
#[derive(Debug, Clone, Copy, Serialize)]
struct Runs {
    best: f64,
    median: f64,
}

/// MB are of raw steps, GB are a thousand of them.
#[derive(Debug, Serialize)]
struct ReplayBench {
    environment: String,
    step_bytes: usize,
    /// Chunks of the newest step are written and synced before the clock stops.
    insert_durable: bool,
    insert_mb_per_s: Runs,
    insert_client_cpu_seconds_per_gb: Runs,
    insert_server_cpu_seconds_per_gb: Runs,
    sample_mb_per_s: Runs,
    /// While sampling.
    client_cpu_seconds_per_gb: Runs,
    /// While sampling.
    server_cpu_seconds_per_gb: Runs,
    mixed_insert_mb_per_s: Runs,
    mixed_sample_mb_per_s: Runs,
    /// How much the server's own memory grew per step that it holds.
    server_bytes_per_step: f64,
    stored_bytes_per_step: f64,
    memcpy_mb_per_s: Runs,
    loopback_mb_per_s: Runs,
    disk_sync_mb_per_s: Runs,
}

/// Runs the command.
pub(super) fn run(args: &ReplayBenchArgs) -> anyhow::Result<()> {
    ensure!(
        args.length <= args.episode_steps,
        "--length {} does not fit into --episode-steps {}",
        args.length,
        args.episode_steps
    );
    let results: Vec<ReplayBench> = args
        .environments
        .iter()
        .map(|environment| measure(args, environment))
        .collect::<Result<_, _>>()?;
    print_result(&results, args.json, |results| table(results))
}

fn work(args: &ReplayBenchArgs, environment: &str) -> Work {
    Work {
        environment: environment.to_owned(),
        episodes: args.episodes,
        episode_steps: usize::from(args.episode_steps),
        image_size: args.image_size,
        action_dim: args.action_dim,
        chunk_steps: usize::from(args.chunk_steps),
        batch_size: usize::from(args.batch),
        batch_length: usize::from(args.length),
        prefetch_batches: usize::from(args.prefetch_batches),
        decoders: usize::from(args.decoders),
        spool_chunks: usize::from(args.spool_chunks),
        segment_bytes: args.segment_bytes,
        address: String::new(),
        folder: args.dir.join("store"),
    }
}

fn measure(args: &ReplayBenchArgs, environment: &str) -> anyhow::Result<ReplayBench> {
    std::fs::create_dir_all(&args.dir)
        .with_context(|| format!("cannot make {}", args.dir.display()))?;
    let mut work = work(args, environment);
    ensure!(
        !work.folder.exists(),
        "{} is left of an earlier run; delete it",
        work.folder.display()
    );
    let mut server = Part::start(Role::Server, &work)?;
    work.address = server.hear()?;
    let mut writer = Part::start(Role::Writer, &work)?;
    let mut sampler = Part::start(Role::Sampler, &work)?;
    let _: String = writer.hear()?;
    let _: String = sampler.hear()?;

    let mb = |steps: u64| (steps as usize * work.step_bytes()) as f64 / 1e6;
    let rate = |done: &Done| mb(done.steps) / done.seconds;
    let per_gb = |cpu: f64, done: &Done| 1e3 * cpu / mb(done.steps);
    let mut columns: [Vec<f64>; 11] = Default::default();
    let before = usage(&mut server)?;
    let mut held_steps = 0;
    let mut own_bytes = 0;
    for _ in 0..args.runs {
        let (inserted, insert_cpu) = alone(&mut writer, &mut server, args.seconds)?;
        let (sampled, sample_cpu) = alone(&mut sampler, &mut server, args.seconds)?;
        writer.ask(&args.seconds.to_string())?;
        sampler.ask(&args.seconds.to_string())?;
        let (mixed_in, mixed_out): (Done, Done) = (writer.hear()?, sampler.hear()?);
        held_steps += inserted.steps + mixed_in.steps;
        own_bytes = usage(&mut server)?.own_bytes;
        let values = [
            rate(&inserted),
            per_gb(inserted.cpu_seconds, &inserted),
            per_gb(insert_cpu, &inserted),
            rate(&sampled),
            per_gb(sampled.cpu_seconds, &sampled),
            per_gb(sample_cpu, &sampled),
            rate(&mixed_in),
            rate(&mixed_out),
            probes::memcpy_mb_per_s(),
            probes::loopback_mb_per_s()?,
            probes::disk_sync_mb_per_s(&args.dir)?,
        ];
        for (column, value) in columns.iter_mut().zip(values) {
            column.push(value);
        }
    }
    drop((writer, sampler, server));
    let stored = stored_bytes(&work.folder)?;
    std::fs::remove_dir_all(&work.folder)?;
    let [
        insert,
        insert_client,
        insert_server,
        sample,
        client,
        server,
        mixed_in,
        mixed_out,
        memcpy,
        loopback,
        disk,
    ] = columns;
    Ok(ReplayBench {
        environment: environment.to_owned(),
        step_bytes: work.step_bytes(),
        insert_durable: true,
        insert_mb_per_s: Runs::rates(insert),
        insert_client_cpu_seconds_per_gb: Runs::costs(insert_client),
        insert_server_cpu_seconds_per_gb: Runs::costs(insert_server),
        sample_mb_per_s: Runs::rates(sample),
        client_cpu_seconds_per_gb: Runs::costs(client),
        server_cpu_seconds_per_gb: Runs::costs(server),
        mixed_insert_mb_per_s: Runs::rates(mixed_in),
        mixed_sample_mb_per_s: Runs::rates(mixed_out),
        server_bytes_per_step: own_bytes.saturating_sub(before.own_bytes) as f64
            / held_steps as f64,
        stored_bytes_per_step: stored as f64 / held_steps as f64,
        memcpy_mb_per_s: Runs::rates(memcpy),
        loopback_mb_per_s: Runs::rates(loopback),
        disk_sync_mb_per_s: Runs::rates(disk),
    })
}

/// What one part does while the others rest, and the server's CPU seconds for it.
fn alone(part: &mut Part, server: &mut Part, seconds: f64) -> anyhow::Result<(Done, f64)> {
    let before = usage(server)?;
    part.ask(&seconds.to_string())?;
    let done = part.hear()?;
    Ok((done, usage(server)?.cpu_seconds - before.cpu_seconds))
}

fn usage(server: &mut Part) -> anyhow::Result<Usage> {
    server.ask("usage")?;
    server.hear()
}

fn stored_bytes(folder: &Path) -> anyhow::Result<u64> {
    let mut bytes = 0;
    for entry in std::fs::read_dir(folder)? {
        bytes += entry?.metadata()?.len();
    }
    Ok(bytes)
}

impl Runs {
    fn rates(values: Vec<f64>) -> Self {
        Self::new(values, f64::max)
    }

    fn costs(values: Vec<f64>) -> Self {
        Self::new(values, f64::min)
    }

    fn new(mut values: Vec<f64>, better: fn(f64, f64) -> f64) -> Self {
        values.sort_by(f64::total_cmp);
        Self {
            best: values.iter().copied().reduce(better).unwrap_or_default(),
            median: values.get(values.len() / 2).copied().unwrap_or_default(),
        }
    }
}

fn table(results: &[ReplayBench]) -> String {
    let mut lines = Vec::new();
    for result in results {
        lines.push(format!(
            "{}: {} raw bytes per step, {:.0} stored, {:.1} of the server's own memory",
            result.environment,
            result.step_bytes,
            result.stored_bytes_per_step,
            result.server_bytes_per_step
        ));
        lines.push(format!("{:<36} {:>8} {:>8}", "", "best", "median"));
        let rows = [
            ("insert, durable, MB/s", result.insert_mb_per_s),
            ("sample, MB/s", result.sample_mb_per_s),
            ("both: insert, MB/s", result.mixed_insert_mb_per_s),
            ("both: sample, MB/s", result.mixed_sample_mb_per_s),
            ("copy in memory, MB/s", result.memcpy_mb_per_s),
            ("loopback TCP, MB/s", result.loopback_mb_per_s),
            ("disk, synced per MB, MB/s", result.disk_sync_mb_per_s),
        ];
        lines.extend(rows.map(|(name, runs)| row(name, runs, 0)));
        let costs = [
            (
                "insert: client CPU s per GB",
                result.insert_client_cpu_seconds_per_gb,
            ),
            (
                "insert: server CPU s per GB",
                result.insert_server_cpu_seconds_per_gb,
            ),
            (
                "sample: client CPU s per GB",
                result.client_cpu_seconds_per_gb,
            ),
            (
                "sample: server CPU s per GB",
                result.server_cpu_seconds_per_gb,
            ),
        ];
        lines.extend(costs.map(|(name, runs)| row(name, runs, 2)));
    }
    lines.join("\n")
}

fn row(name: &str, runs: Runs, decimals: usize) -> String {
    format!(
        "{name:<36} {:>8.decimals$} {:>8.decimals$}",
        runs.best, runs.median
    )
}
