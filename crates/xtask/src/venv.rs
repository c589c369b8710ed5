//! Virtual environments of Python in `.native`, each made once.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result};

use crate::stage::{run, stage};

/// A folder with Python and packages.
#[derive(Debug, Clone)]
pub(crate) struct Venv {
    folder: PathBuf,
}

impl Venv {
    /// `.native/{name}`, made anew by the stage `title` unless it was made for the same `wanted`: `install` puts into it
    /// what that names.
    pub(crate) fn ensure(
        root: &Path,
        name: &str,
        wanted: &str,
        title: &str,
        install: impl FnOnce(&Self) -> Result<()>,
    ) -> Result<Self> {
        let native = root.join(".native");
        let venv = Self {
            folder: native.join(name),
        };
        // Tests are processes that may all come here at once.
        let lock = native.join(format!("{name}.lock"));
        let _held = fs::create_dir_all(&native)
            .and_then(|()| File::create(&lock))
            .and_then(|file| file.lock().map(|()| file))
            .with_context(|| format!("cannot lock {}", lock.display()))?;
        let done = venv.folder.join("complete");
        if fs::read_to_string(&done).ok().as_deref() != Some(wanted) {
            stage(title, || {
                run(Command::new("python3")
                    .args(["-m", "venv", "--clear"])
                    .arg(&venv.folder))
                .context(
                    "python3 cannot make an environment: install it (Debian, Ubuntu: apt-get install python3-venv)",
                )?;
                install(&venv).context(
                    "pip's own words are above: check the network, the proxy (HTTPS_PROXY) and pip's index",
                )?;
                fs::write(&done, wanted).with_context(|| format!("cannot write {}", done.display()))
            })?;
        }
        Ok(venv)
    }

    /// A program that was installed, `python` for Python itself.
    pub(crate) fn program(&self, name: &str) -> PathBuf {
        self.folder.join("bin").join(name)
    }

    /// `pip install`, to be told what.
    pub(crate) fn pip(&self) -> Command {
        let mut command = Command::new(self.program("python"));
        command.args([
            "-m",
            "pip",
            "install",
            "--quiet",
            "--disable-pip-version-check",
        ]);
        command
    }
}
