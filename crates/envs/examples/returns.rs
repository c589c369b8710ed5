//! Returns of the scripted drivers and the simulator's speed.
//!
//! `cargo run --release -p isodream-envs --example returns -- [episodes]`

#![allow(clippy::print_stdout)]

use std::error::Error;
use std::time::Instant;

use isodream_core::config::EnvConfig;
use isodream_envs::{ScriptedDriver, make};

fn main() -> Result<(), Box<dyn Error>> {
    let episodes = std::env::args()
        .nth(1)
        .map_or(Ok(10), |text| text.parse())?;
    let mut env = make(&EnvConfig::default())?;
    for scripted in ScriptedDriver::ALL {
        let mut returns = Vec::new();
        let mut steps = 0_u32;
        let mut ends = Vec::new();
        let mut totals: Vec<(&str, f64)> = Vec::new();
        let started = Instant::now();
        for seed in 0..episodes {
            let mut driver = scripted.driver(seed);
            let mut transition = env.reset(seed)?;
            let mut sum = 0.0;
            while !transition.is_last {
                let action = driver.act(env.as_ref())?;
                transition = env.step(&action)?;
                sum += f64::from(transition.reward);
                steps += 1;
            }
            returns.push(sum);
            ends.extend(transition.end_reason);
            for (index, (name, value)) in env.metrics().into_iter().enumerate() {
                if totals.len() <= index {
                    totals.push((name, 0.0));
                }
                totals[index].1 += value / episodes as f64;
            }
        }
        let frames_per_s = f64::from(steps) / started.elapsed().as_secs_f64();
        let mean = returns.iter().sum::<f64>() / returns.len() as f64;
        let variance =
            returns.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / returns.len() as f64;
        println!(
            "{scripted}: return {mean:.1} +- {:.1}, length {:.0}, {frames_per_s:.0} agent steps/s",
            variance.sqrt(),
            f64::from(steps) / returns.len() as f64,
        );
        println!("  returns {returns:.0?}");
        println!("  ends {ends:?}");
        println!("  {totals:.1?}");
    }
    Ok(())
}
