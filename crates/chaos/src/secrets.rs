//! Certificates and tokens, made by `isodream secrets`.

use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Context, Result, ensure};
use isodream_rpc::{Credentials, Dialer, Files, Role};

use crate::faketime;

/// Makes them in `folder`, for servers at `hosts`, valid for a day; at another time where `at` names one as
/// libfaketime takes it.
pub(crate) fn make(binary: &Path, folder: &Path, hosts: &[String], at: Option<&str>) -> Result<()> {
    let mut command = Command::new(binary);
    command.arg("secrets").arg(folder).args(["--days", "1"]);
    for host in hosts {
        command.args(["--host", host]);
    }
    if let Some(at) = at {
        command
            .env("LD_PRELOAD", faketime::library()?)
            .env("FAKETIME", at);
    }
    let output = command
        .stdin(Stdio::null())
        .output()
        .with_context(|| format!("cannot start {}", binary.display()))?;
    let words = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "isodream secrets failed: {words}");
    Ok(())
}

/// How a client in this role reaches servers whose secrets lie in `folder`; without one, openly.
pub(crate) fn dialer(folder: Option<&Path>, role: Role) -> Result<Dialer> {
    let files = folder.map_or_else(Files::default, |folder| Files::of_client(folder, role));
    Ok(Dialer::new(Credentials::load(&files)?))
}
