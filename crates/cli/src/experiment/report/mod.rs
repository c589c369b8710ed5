//! What an experiment came to, beside what the paper reports.

mod figure;
mod page;

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use isodream_telemetry::write_whole;

use self::figure::summary;
use self::page::{Page, Section, Table};
use super::Choice;
use super::definition::{Definition, Method, Variant};
use super::evaluation::Evaluation;
use super::plan::{Plan, Run};
use crate::chart::{Line, draw};
use crate::report::Curve;

/// Writes `report.md`, `report.html` and the figures into the experiment's folder, and returns that.
pub(super) fn report(choice: &Choice, smooth: usize) -> anyhow::Result<PathBuf> {
    let (name, definition) = choice.definition()?;
    let folder = choice.out.join(&name).join(choice.scale.as_str());
    let plan = Plan::new(&definition, choice.scale, &folder)?;
    let made = plan.made()?;
    if made.is_empty() {
        bail!(
            "nothing of {name} was run at scale {} in {}; run it first: isodream experiment run {name} --scale {}",
            choice.scale.as_str(),
            choice.out.display(),
            choice.scale.as_str()
        );
    }
    let sections = definition
        .tasks
        .iter()
        .map(|task| section(&definition, &made, task, &folder, smooth))
        .collect::<anyhow::Result<_>>()?;
    let page = Page {
        title: definition.title.clone(),
        about: definition.about.clone(),
        facts: vec![
            format!("In the paper: {}.", definition.source),
            scale_in_words(&plan, &made, choice)?,
            format!(
                "Made by: isodream experiment run {name} --scale {0}; isodream experiment report {name} --scale {0}",
                choice.scale.as_str()
            ),
        ],
        sections,
    };
    write_whole(&folder.join("report.md"), page.markdown().as_bytes())?;
    write_whole(&folder.join("report.html"), page.html().as_bytes())?;
    Ok(folder)
}

/// How large it was, so that nobody takes it for more than it is.
fn scale_in_words(plan: &Plan, made: &[&Run], choice: &Choice) -> anyhow::Result<String> {
    let mut frames: Vec<u64> = Vec::new();
    let mut updates: Vec<u64> = Vec::new();
    for run in made {
        let evaluation = Evaluation::read(&run.evaluation())?;
        frames.push(evaluation.env_frames);
        updates.push(evaluation.updates);
    }
    let range = |values: &[u64]| {
        let (least, most) = (values.iter().min(), values.iter().max());
        match (least, most) {
            (Some(least), Some(most)) if least != most => format!("{least} to {most}"),
            _ => least.map_or_else(String::new, u64::to_string),
        }
    };
    Ok(format!(
        "Scale {}: {} of {} runs, each of {} environment frames and {} updates. The paper trains for 500,000 frames at its own sizes.",
        choice.scale.as_str(),
        made.len(),
        plan.runs.len(),
        range(&frames),
        range(&updates)
    ))
}

fn section(
    definition: &Definition,
    made: &[&Run],
    task: &Variant,
    folder: &Path,
    smooth: usize,
) -> anyhow::Result<Section> {
    let runs_of = |method: &Method| -> Vec<&Run> {
        let mine = |run: &&Run| run.task == task.name && run.method == method.name;
        made.iter().copied().filter(mine).collect()
    };
    let mut lines: Vec<Line> = Vec::new();
    let mut columns = vec![
        "method".to_owned(),
        "seeds".to_owned(),
        "return".to_owned(),
        "the paper".to_owned(),
    ];
    for test in &definition.tests {
        columns.extend([test.label.clone(), "the paper".to_owned()]);
    }
    let mut rows = Vec::new();
    for method in &definition.methods {
        let runs = runs_of(method);
        let curve = |run: &&Run| {
            let curve = Curve::read(&run.dir, &definition.metric);
            curve
                .inspect_err(|error| {
                    tracing::warn!(
                        run = run.name(),
                        error = format!("{error:#}"),
                        "no curve is drawn"
                    );
                })
                .ok()
        };
        let curves = runs
            .iter()
            .filter_map(curve)
            .map(|curve| curve.smoothed(smooth).points);
        lines.extend(summary(&method.label, &curves.collect::<Vec<_>>()));
        let key = if task.name.is_empty() {
            "return"
        } else {
            &task.name
        };
        let reported = |key: &str| method.reported.get(key).cloned().unwrap_or_default();
        let mut row = vec![
            method.label.clone(),
            runs.len().to_string(),
            spread(&trained(runs.iter().map(|run| run.evaluation()))?),
            reported(key),
        ];
        for test in &definition.tests {
            let files = runs
                .iter()
                .map(|run| run.test(test))
                .filter(|path| path.exists());
            row.push(spread(&trained(files)?));
            row.push(reported(&format!("{}/{key}", test.name)));
        }
        rows.push(row);
    }
    let figure = match task.name.as_str() {
        "" => "curves.svg".to_owned(),
        name => format!("curves-{name}.svg"),
    };
    draw(&folder.join(&figure), &definition.metric, &lines, &[])?;
    Ok(Section {
        title: task.label.clone(),
        figure,
        caption: format!(
            "{} over environment frames, mean of the newest {smooth}: median and interquartile range over seeds.",
            definition.metric
        ),
        table: Table { columns, rows },
    })
}

/// Mean returns of the trained policies in some evaluations.
fn trained(files: impl Iterator<Item = PathBuf>) -> anyhow::Result<Vec<f64>> {
    files
        .map(|path| {
            let trained = Evaluation::read(&path)?.trained();
            trained.with_context(|| format!("{} has no trained policy", path.display()))
        })
        .collect()
}

/// Mean and standard deviation over seeds, as the paper gives them.
fn spread(values: &[f64]) -> String {
    if values.is_empty() {
        return "not run".to_owned();
    }
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    if values.len() == 1 {
        return format!("{mean:.1}");
    }
    let square = values
        .iter()
        .map(|value| (value - mean).powi(2))
        .sum::<f64>();
    format!("{mean:.1} ± {:.1}", (square / (count - 1.0)).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_spread_is_over_seeds() {
        assert_eq!(spread(&[]), "not run");
        assert_eq!(spread(&[3.0]), "3.0");
        assert_eq!(spread(&[1.0, 2.0, 6.0]), "3.0 ± 2.6");
    }
}
