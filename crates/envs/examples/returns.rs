//! What the scripted drivers earn: mean and spread of the return over seeds, for each environment id.
//!
//! `cargo run --release -p isodream-envs --example returns -- [episodes] [id ...]`

#![allow(clippy::print_stdout)]

use std::error::Error;

use isodream_core::config::EnvConfig;
use isodream_envs::{Environment, ScriptedDriver, make};

const METRICS: [&str; 5] = [
    "mean_speed_m_s",
    "collisions",
    "barrier_hits",
    "lane_changes",
    "interactions",
];

/// Means over the episodes of one driver.
struct Summary {
    mean: f64,
    spread: f64,
    length: f64,
    metrics: [f64; METRICS.len()],
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let episodes = arguments.next().map_or(Ok(20), |text| text.parse())?;
    let mut ids: Vec<String> = arguments.collect();
    if ids.is_empty() {
        ids = ["highway/day", "highway/night"].map(String::from).into();
    }
    for id in ids {
        let mut env = make(&EnvConfig {
            id: id.clone(),
            ..EnvConfig::default()
        })?;
        println!("{id}, {episodes} episodes each");
        println!(
            "{:<12} {:>16} {:>7}  {}",
            "driver",
            "return",
            "length",
            METRICS.join("  ")
        );
        for scripted in ScriptedDriver::ALL {
            let found = summarise(env.as_mut(), scripted, episodes)?;
            print!(
                "{:<12} {:>8.1} +- {:>4.1} {:>7.0}",
                scripted.as_str(),
                found.mean,
                found.spread,
                found.length
            );
            for (name, value) in METRICS.iter().zip(found.metrics) {
                print!("  {value:>width$.1}", width = name.len());
            }
            println!();
        }
    }
    Ok(())
}

fn summarise(
    env: &mut dyn Environment,
    scripted: ScriptedDriver,
    episodes: u64,
) -> Result<Summary, Box<dyn Error>> {
    let mut returns = Vec::new();
    let mut steps = 0_u32;
    let mut metrics = [0.0; METRICS.len()];
    for seed in 0..episodes {
        let mut driver = scripted.driver(seed);
        let mut transition = env.reset(seed)?;
        let mut sum = 0.0;
        while !transition.is_last {
            let action = driver.act(env)?;
            transition = env.step(&action)?;
            sum += f64::from(transition.reward);
            steps += 1;
        }
        returns.push(sum);
        for (name, value) in env.metrics() {
            if let Some(index) = METRICS.iter().position(|wanted| *wanted == name) {
                metrics[index] += value / episodes as f64;
            }
        }
    }
    let count = returns.len() as f64;
    let mean = returns.iter().sum::<f64>() / count;
    let variance = returns.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / count;
    Ok(Summary {
        mean,
        spread: variance.sqrt(),
        length: f64::from(steps) / count,
        metrics,
    })
}
