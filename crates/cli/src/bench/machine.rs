//! What this machine can do at best, as the measure of everything else.

use std::time::Instant;

use anyhow::Context;
use tch::{Device, Kind, Tensor};

/// Sides of the square matrices; the best of them counts.
const SIDES: [i64; 3] = [512, 1024, 2048];

/// Seconds spent on each side.
const BUDGET: f64 = 0.5;

/// Matrix-product rate in GFLOP/s with this process's threads, the best over several sizes. Where the smallest product
/// takes all the time already (bf16 on a CPU that only emulates it), the larger ones are left out.
pub(super) fn gemm_gflops(kind: Kind, device: Device) -> f64 {
    let _guard = tch::no_grad_guard();
    let mut rate = 0.0_f64;
    for side in SIDES {
        let matrix = || Tensor::rand([side, side], (Kind::Float, device)).to_kind(kind);
        let (a, b) = (matrix(), matrix());
        let flops = 2.0 * (side as f64).powi(3);
        let begun = Instant::now();
        let mut products = 0;
        while begun.elapsed().as_secs_f64() < BUDGET {
            let once = Instant::now();
            let product = a.matmul(&b);
            // Reading one number waits for the device.
            product.double_value(&[0, 0]);
            rate = rate.max(flops / once.elapsed().as_secs_f64() / 1e9);
            products += 1;
        }
        if products < 8 {
            break;
        }
    }
    rate
}

/// The most memory this process has had, in bytes.
pub(super) fn peak_rss_bytes() -> anyhow::Result<u64> {
    let status = std::fs::read_to_string("/proc/self/status")
        .context("cannot read /proc/self/status, which only Linux has")?;
    let kib = status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))
        .and_then(|rest| rest.split_whitespace().next())
        .and_then(|number| number.parse::<u64>().ok())
        .context("/proc/self/status has no VmHWM")?;
    Ok(kib * 1024)
}
