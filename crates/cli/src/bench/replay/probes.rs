//! What this machine and this process can say for comparison.

use std::fs::File;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::time::Instant;

use anyhow::Context;
use rustix::time::{ClockId, clock_gettime};

/// Seconds spent on each measurement of the machine.
const BUDGET: f64 = 0.5;

/// CPU time of all threads of this process so far.
pub(super) fn cpu_seconds() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

/// Memory of this process that no file stands for.
pub(super) fn own_bytes() -> anyhow::Result<u64> {
    let status = std::fs::read_to_string("/proc/self/status")
        .context("cannot read /proc/self/status, which only Linux has")?;
    let kib = status
        .lines()
        .find_map(|line| line.strip_prefix("RssAnon:"))
        .and_then(|rest| rest.split_whitespace().next())
        .and_then(|number| number.parse::<u64>().ok())
        .context("/proc/self/status has no RssAnon")?;
    Ok(kib * 1024)
}

/// Copying 64 MB, more than caches hold, in MB/s.
pub(super) fn memcpy_mb_per_s() -> f64 {
    let source = vec![1_u8; 64 << 20];
    let mut target = vec![0_u8; 64 << 20];
    rate(source.len(), || {
        std::hint::black_box(&mut target).copy_from_slice(std::hint::black_box(&source));
        Ok(())
    })
    .unwrap_or_default()
}

/// One TCP connection on loopback, in MB/s.
pub(super) fn loopback_mb_per_s() -> anyhow::Result<f64> {
    const BYTES: usize = 64 << 20;
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let mut sending = TcpStream::connect(listener.local_addr()?)?;
    let (mut receiving, _) = listener.accept()?;
    std::thread::spawn(move || {
        let block = vec![1_u8; 1 << 20];
        while sending.write_all(&block).is_ok() {}
    });
    let mut block = vec![0_u8; 1 << 20];
    rate(BYTES, || {
        for _ in 0..BYTES / block.len() {
            receiving.read_exact(&mut block)?;
        }
        Ok(())
    })
}

/// Appending blocks of 1 MB to a file in `folder`, each made durable, in MB/s.
pub(super) fn disk_sync_mb_per_s(folder: &Path) -> anyhow::Result<f64> {
    let path = folder.join("probe");
    let mut file = File::create(&path)?;
    let block = vec![1_u8; 1 << 20];
    let begun = Instant::now();
    let mut written = 0;
    while begun.elapsed().as_secs_f64() < 2.0 * BUDGET {
        file.write_all(&block)?;
        file.sync_data()?;
        written += block.len();
    }
    let seconds = begun.elapsed().as_secs_f64();
    std::fs::remove_file(&path)?;
    Ok(written as f64 / seconds / 1e6)
}

/// The best rate of doing something with `bytes`, in MB/s.
fn rate(bytes: usize, mut once: impl FnMut() -> anyhow::Result<()>) -> anyhow::Result<f64> {
    let mut best = 0.0_f64;
    let begun = Instant::now();
    while begun.elapsed().as_secs_f64() < BUDGET {
        let since = Instant::now();
        once()?;
        best = best.max(bytes as f64 / since.elapsed().as_secs_f64() / 1e6);
    }
    Ok(best)
}
