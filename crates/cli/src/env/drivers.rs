//! `isodream env drivers`: what drivers earn that look at the world itself, and what looking is worth.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use anyhow::bail;
use clap::Args;
use isodream_envs::{
    BLIND_PEDALS, BlindDriver, Score, ScriptedDriver, ids, make_without_pictures, score,
};
use serde::Serialize;

use super::env_config;
use crate::output::print_result;

/// Drivers beside the blind ones, best first.
const DRIVERS: [ScriptedDriver; 5] = [
    ScriptedDriver::Foreseeing,
    ScriptedDriver::Reacting,
    ScriptedDriver::KeepLane,
    ScriptedDriver::Wander,
    ScriptedDriver::Random,
];

/// Options of `isodream env drivers`.
#[derive(Debug, Args)]
pub(crate) struct DriversArgs {
    /// Ids of the highway; all of them if none is given
    ids: Vec<String>,
    /// Episodes per driver
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u64).range(1..))]
    episodes: u64,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

/// Mean returns on one id, and more about each driver.
#[derive(Debug, Clone, Serialize)]
struct Ranking {
    id: String,
    episodes: u64,
    best_blind: f64,
    keep_lane: f64,
    reacting: f64,
    foreseeing: f64,
    blind_over_keep_lane: f64,
    keep_lane_over_reacting: f64,
    reacting_over_foreseeing: f64,
    best_blind_pedal: f32,
    drivers: BTreeMap<&'static str, Facts>,
    pedals: Vec<Pedal>,
}

/// Means over the episodes of a driver.
#[derive(Debug, Clone, Serialize)]
struct Facts {
    return_mean: f64,
    return_std: f64,
    length: f64,
    mean_speed_m_s: f64,
    contact_share: f64,
    lane_changes: f64,
    impulse_ns: f64,
}

/// What holding one pedal earns, in the lane that the episode starts in and elsewhere.
#[derive(Debug, Clone, Copy, Serialize)]
struct Pedal {
    pedal: f32,
    return_mean: f64,
    return_std: f64,
    /// Next to the right barrier in place of the lane that the episode starts in.
    shoulder_return_mean: f64,
}

/// Runs the command.
pub(super) fn run(args: &DriversArgs) -> anyhow::Result<()> {
    let mut found: BTreeMap<String, Ranking> = BTreeMap::new();
    let mut rankings = Vec::new();
    for id in chosen(&args.ids)? {
        let roads = road(id).to_owned();
        let ranking = match found.get(&roads) {
            Some(ranking) => ranking.clone(),
            None => {
                let ranking = rank(id, args.episodes)?;
                found.insert(roads, ranking.clone());
                ranking
            }
        };
        rankings.push(Ranking {
            id: id.to_owned(),
            ..ranking
        });
    }
    print_result(&rankings, args.json, |rankings| {
        let tables: Vec<String> = rankings.iter().map(Ranking::table).collect();
        tables.join("\n\n")
    })
}

/// The asked ids, or all of the highway.
fn chosen(asked: &[String]) -> anyhow::Result<Vec<&str>> {
    let known: Vec<&str> = ids()
        .iter()
        .copied()
        .filter(|id| id.starts_with("highway/"))
        .collect();
    if asked.is_empty() {
        return Ok(known);
    }
    for id in asked {
        if !known.contains(&id.as_str()) {
            bail!(
                "no scripted drivers for environment id \"{id}\", known ids: {}",
                known.join(", ")
            );
        }
    }
    Ok(asked.iter().map(String::as_str).collect())
}

/// The id without its time of day, which changes pictures only.
fn road(id: &str) -> &str {
    id.rsplit_once('/').map_or(id, |(road, _)| road)
}

fn rank(id: &str, episodes: u64) -> anyhow::Result<Ranking> {
    let mut env = make_without_pictures(&env_config(id, &[])?)?;
    let mut drivers = BTreeMap::new();
    for scripted in DRIVERS {
        let score = score(env.as_mut(), episodes, &|seed| scripted.driver(seed))?;
        drivers.insert(scripted.as_str(), Facts::new(&score));
    }
    let mut pedals = Vec::new();
    let mut best: Option<(f32, Facts)> = None;
    for pedal in BLIND_PEDALS {
        let lane = |_| Box::new(BlindDriver::new(pedal)) as _;
        let shoulder = |_| Box::new(BlindDriver::on_the_shoulder(pedal)) as _;
        let lane = Facts::new(&score(env.as_mut(), episodes, &lane)?);
        let shoulder = Facts::new(&score(env.as_mut(), episodes, &shoulder)?);
        pedals.push(Pedal {
            pedal,
            return_mean: lane.return_mean,
            return_std: lane.return_std,
            shoulder_return_mean: shoulder.return_mean,
        });
        for facts in [lane, shoulder] {
            if (best.as_ref()).is_none_or(|(_, best)| facts.return_mean > best.return_mean) {
                best = Some((pedal, facts));
            }
        }
    }
    let mut best_blind_pedal = f32::NAN;
    if let Some((pedal, facts)) = best {
        best_blind_pedal = pedal;
        drivers.insert(BEST_BLIND, facts);
    }
    let mean = |name: &str| drivers.get(name).map_or(f64::NAN, |it| it.return_mean);
    let [blind, keep_lane, reacting, foreseeing] =
        [BEST_BLIND, "keep_lane", "reacting", "foreseeing"].map(mean);
    Ok(Ranking {
        id: id.to_owned(),
        episodes,
        best_blind: blind,
        keep_lane,
        reacting,
        foreseeing,
        blind_over_keep_lane: blind / keep_lane,
        keep_lane_over_reacting: keep_lane / reacting,
        reacting_over_foreseeing: reacting / foreseeing,
        best_blind_pedal,
        drivers,
        pedals,
    })
}

const BEST_BLIND: &str = "best_blind";

impl Facts {
    fn new(score: &Score) -> Self {
        Self {
            return_mean: score.mean(),
            return_std: score.std(),
            length: score.length,
            mean_speed_m_s: score.metric("mean_speed_m_s"),
            contact_share: score.metric("contact_share"),
            lane_changes: score.metric("lane_changes"),
            impulse_ns: score.metric("impulse_ns"),
        }
    }
}

impl Ranking {
    fn table(&self) -> String {
        let mut text = format!(
            "{}, {} episodes each\n{:<12} {:>16} {:>7} {:>10} {:>8} {:>13} {:>12}\n",
            self.id,
            self.episodes,
            "driver",
            "return",
            "length",
            "speed m/s",
            "contact",
            "lane changes",
            "impulse N s"
        );
        let mut rows: Vec<_> = self.drivers.iter().collect();
        rows.sort_by(|a, b| b.1.return_mean.total_cmp(&a.1.return_mean));
        for (name, it) in rows {
            let score = format!("{:.1} +- {:.1}", it.return_mean, it.return_std);
            // Writing to a string cannot fail.
            let _ = writeln!(
                text,
                "{name:<12} {score:>16} {:>7.0} {:>10.1} {:>7.0}% {:>13.1} {:>12.0}",
                it.length,
                it.mean_speed_m_s,
                100.0 * it.contact_share,
                it.lane_changes,
                it.impulse_ns
            );
        }
        let _ = write!(
            text,
            "best_blind / keep_lane {:.2}, keep_lane / reacting {:.2}, reacting / foreseeing {:.2}\npedal held:",
            self.blind_over_keep_lane, self.keep_lane_over_reacting, self.reacting_over_foreseeing
        );
        for it in &self.pedals {
            let _ = write!(text, " {}: {:.1}", it.pedal, it.return_mean);
        }
        text += "\nthe same on the shoulder:";
        for it in &self.pedals {
            let _ = write!(text, " {}: {:.1}", it.pedal, it.shoulder_return_mean);
        }
        text
    }
}
