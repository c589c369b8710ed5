//! A virtual environment of Python that holds dm_control.

use std::fmt::Display;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus};

use crate::dmc::ControlError;

/// The releases that the tasks and the library are taken from.
const REQUIREMENTS: [&str; 2] = ["dm-control==1.0.50", "mujoco==3.17.0"];
/// How much of what a failed command said is passed on.
const SAID_LINES: usize = 5;

/// Makes `folder` unless it is complete, and returns its Python.
pub(super) fn install(folder: &Path) -> Result<PathBuf, ControlError> {
    let python = folder.join("bin/python");
    let stamp = folder.join("complete");
    let contents = REQUIREMENTS.join("\n");
    let _lock = lock(folder).map_err(|error| failed(&error))?;
    if fs::read_to_string(&stamp).ok().as_ref() == Some(&contents) {
        return Ok(python);
    }
    run(Command::new("python3")
        .args(["-m", "venv", "--clear"])
        .arg(folder))?;
    run(Command::new(&python)
        .args(["-m", "pip", "install", "--quiet"])
        .arg("--disable-pip-version-check")
        .args(REQUIREMENTS))?;
    fs::write(stamp, contents).map_err(|error| failed(&error))?;
    Ok(python)
}

/// One installation at a time: a second one waits, and then finds everything in place.
fn lock(folder: &Path) -> io::Result<File> {
    let path = folder.with_extension("lock");
    if let Some(parent) = path.parent() {
        fs::create_dir_all(parent)?;
    }
    let file = File::create(path)?;
    file.lock()?;
    Ok(file)
}

fn run(command: &mut Command) -> Result<(), ControlError> {
    let output = command
        .output()
        .map_err(|error| failed(&format!("{}: {error}", command.get_program().display())))?;
    if output.status.success() {
        return Ok(());
    }
    // venv complains on stdout.
    let text = [output.stdout, output.stderr].concat();
    Err(failed(&said(output.status, &text)))
}

/// The status of a failed command, and the end of what it said.
pub(super) fn said(status: ExitStatus, text: &[u8]) -> String {
    let text = String::from_utf8_lossy(text);
    let lines: Vec<&str> = text.lines().collect();
    let last = &lines[lines.len().saturating_sub(SAID_LINES)..];
    format!("{status}: {}", last.join("; "))
}

fn failed(reason: &dyn Display) -> ControlError {
    ControlError::Peer {
        what: "install dm_control",
        reason: reason.to_string(),
    }
}
