//! Checkpoints that the disk damaged.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};

use super::{Context, RECOVERY, finish};
use crate::cluster::Cluster;
use crate::interrupt;
use crate::plan::Plan;
use crate::table::Row;
use crate::watch::Inserts;

/// How long the learner may take for two checkpoints.
const TWO_CHECKPOINTS: Duration = Duration::from_secs(120);

type Damage = fn(&Path) -> Result<()>;

pub(super) fn run(context: &Context) -> Result<Vec<Row>> {
    let cluster = Cluster::start(&context.binary, Plan::usual(&[]))?;
    let damages: [(&str, Damage); 3] = [
        ("a byte of its weights flipped", |folder| {
            let path = folder.join("model.safetensors");
            let mut bytes = fs::read(&path)?;
            let middle = bytes.len() / 2;
            *bytes.get_mut(middle).context("the weights are empty")? ^= 1;
            Ok(fs::write(&path, bytes)?)
        }),
        ("its optimizer state cut in half", |folder| {
            let path = folder.join("optimizer.safetensors");
            let bytes = fs::read(&path)?;
            Ok(fs::write(&path, &bytes[..bytes.len() / 2])?)
        }),
        ("its manifest missing", |folder| {
            Ok(fs::remove_file(folder.join("manifest.json"))?)
        }),
    ];
    let mut rows = Vec::new();
    for (how, damage) in damages {
        let mut row = Row::new(
            "the newest checkpoint is damaged",
            &format!("{how}, after kill -9 of the learner"),
        );
        for _ in 0..context.kills.clamp(1, 3) {
            row.tried += 1;
            let recovered = damaged(&cluster, damage, &mut row);
            row.recovered(recovered);
        }
        rows.push(row);
    }
    // The learner goes back by one checkpoint more.
    let (begun, rollback) = (cluster.begun(), 2 * super::rollback(&cluster));
    finish(cluster, begun, rollback, &mut rows)?;
    Ok(rows)
}

fn damaged(cluster: &Cluster, damage: Damage, row: &mut Row) -> Result<f64> {
    let learner = cluster.role("learner")?;
    let before = numbered(&cluster.checkpoints())?.last().cloned();
    interrupt::until("two more checkpoints are there", TWO_CHECKPOINTS, || {
        let all = numbered(&cluster.checkpoints())?;
        let newer = all
            .iter()
            .filter(|path| Some(*path) > before.as_ref())
            .count();
        Ok((newer >= 2).then_some(()))
    })?;
    learner.hold();
    learner.kill()?;
    let (start, mark) = (learner.log_end(), cluster.mark());
    let folders = numbered(&cluster.checkpoints())?;
    let [.., sound, newest] = folders.as_slice() else {
        anyhow::bail!("the learner keeps less than two checkpoints: {folders:?}");
    };
    damage(newest)?;
    let at = Instant::now();
    learner.release(|_| {});
    let seconds = cluster.watch.recovery(at, Inserts::Any, RECOVERY)?;
    let updates: u64 = name(sound).parse()?;
    let resumed = format!("resumed from checkpoint updates={updates}");
    cluster.line(&mark, "learner", &resumed, RECOVERY)?;
    let log = learner.log_since(start)?;
    let lines: Vec<_> = log
        .lines()
        .filter(|line| line.contains("passing over a damaged checkpoint"))
        .collect();
    ensure!(
        lines.len() == 1,
        "{} lines tell of the damage: {lines:?}",
        lines.len()
    );
    ensure!(
        lines[0].contains(&name(newest)),
        "the damaged folder is not named: {}",
        lines[0]
    );
    if row.notes.is_empty() {
        row.notes.push(format!("the learner says: {}", lines[0]));
    }
    Ok(seconds)
}

/// The checkpoints in `dir` by age, the newest last; none while there is no folder yet.
pub(super) fn numbered(dir: &Path) -> Result<Vec<PathBuf>> {
    let Ok(entries) = fs::read_dir(dir) else {
        return Ok(Vec::new());
    };
    let mut found = Vec::new();
    for entry in entries {
        let path = entry?.path();
        if name(&path).bytes().all(|byte| byte.is_ascii_digit()) {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

fn name(path: &Path) -> String {
    path.file_name()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned()
}
