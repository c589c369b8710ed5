//! An experiment from its first run to its report.

use anyhow::{Result, ensure};
use isodream_tests::isodream;

#[test]
fn an_experiment_is_run_once_and_reported_beside_the_paper() -> Result<()> {
    let folder = tempfile::tempdir()?;
    let out = folder.path().display().to_string();
    let experiment = |command: &str| {
        isodream(&[
            "experiment",
            command,
            "driving",
            "--scale",
            "smoke",
            "--out",
            &out,
        ])
    };
    let early = experiment("report")?;
    let words = String::from_utf8_lossy(&early.stderr).into_owned();
    ensure!(
        !early.status.success() && words.contains("isodream experiment run driving"),
        "{words}"
    );

    let first = experiment("run")?;
    let words = String::from_utf8_lossy(&first.stderr).into_owned();
    ensure!(first.status.success(), "{words}");
    ensure!(
        words.contains("2 of 2: single_branch/seed-0: done"),
        "{words}"
    );
    let again = experiment("run")?;
    let words = String::from_utf8_lossy(&again.stderr).into_owned();
    ensure!(again.status.success(), "{words}");
    ensure!(words.matches("was made before").count() == 2, "{words}");

    let made = folder.path().join("driving/smoke");
    let config = made.join("iso_dream_pp/seed-0/config.toml");
    let ours = std::fs::read_to_string(&config)?;
    std::fs::write(&config, ours.replace("batch_size = 4", "batch_size = 5"))?;
    for command in ["run", "report"] {
        let refused = experiment(command)?;
        let words = String::from_utf8_lossy(&refused.stderr).into_owned();
        ensure!(
            !refused.status.success() && words.contains("seed-0 was made with other settings"),
            "{words}"
        );
    }
    std::fs::write(&config, ours)?;

    let report = experiment("report")?;
    ensure!(report.status.success(), "{report:?}");
    let markdown = std::fs::read_to_string(made.join("report.md"))?;
    ensure!(
        markdown.contains("| Iso-Dream++ | 1 | ") && markdown.contains(" | about 60 |"),
        "{markdown}"
    );
    ensure!(markdown.contains("2 of 2 runs, each of "), "{markdown}");
    let html = std::fs::read_to_string(made.join("report.html"))?;
    ensure!(
        html.contains("<td>single branch (the paper: DreamerV2)</td>"),
        "{html}"
    );
    let curves = std::fs::read_to_string(made.join("curves.svg"))?;
    ensure!(curves.contains("Iso-Dream++"), "the figure has no legend");
    Ok(())
}

#[test]
fn unknown_names_are_refused_with_those_that_there_are() -> Result<()> {
    for (args, words) in [
        (&["experiment", "run", "drivin"][..], "known: driving, "),
        (
            &["experiment", "run", "driving", "--methods", "x"],
            "--methods x: known are iso_dream_pp, single_branch",
        ),
        (
            &["experiment", "run", "driving", "--seeds", "5"],
            "--seeds 5: this experiment has 1 to 3",
        ),
        (
            &["experiment", "run", "driving", "--seeds", "0"],
            "--seeds 0: this experiment has 1 to 3",
        ),
    ] {
        let output = isodream(args)?;
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        ensure!(!output.status.success() && said.contains(words), "{said}");
    }
    Ok(())
}
