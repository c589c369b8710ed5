//! The folder that is sent to `docker build`: the files that the Dockerfile copies, stripped, and nothing else.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, ensure};

use crate::run::target_dir;
use crate::stage::{answers, output, run, with_native};

/// Makes the context for the images with or without libtorch anew, from `binary`.
pub(super) fn make(root: &Path, binary: &Path, needs_torch: bool) -> Result<PathBuf> {
    ensure!(
        answers(Command::new("strip").arg("--version")),
        "strip is missing, it halves the images: install it (Debian, Ubuntu: apt-get install binutils)"
    );
    let name = if needs_torch { "torch" } else { "torch-free" };
    let context = target_dir(root)?.join("image").join(name);
    if context.exists() {
        fs::remove_dir_all(&context)
            .with_context(|| format!("cannot remove {}", context.display()))?;
    }
    folder(&context.join("state"))?;
    // Names of functions stay, for what a panic prints.
    strip("--strip-debug", binary, &context.join("bin/isodream"))?;
    let libraries = native_libraries(root, binary)?;
    if needs_torch {
        ensure!(
            !libraries.is_empty(),
            "{} does not use libtorch: it was built without",
            binary.display()
        );
        for library in &libraries {
            let name = library.file_name().context("a library without a name")?;
            strip(
                "--strip-unneeded",
                library,
                &context.join("torch").join(name),
            )?;
        }
        mujoco(root, &context.join("mujoco"))?;
    } else {
        ensure!(
            libraries.is_empty(),
            "{} uses libtorch: build it with --no-default-features",
            binary.display()
        );
    }
    Ok(context)
}

/// MuJoCo's library under the name by which it is looked for, and the models of its tasks.
fn mujoco(root: &Path, to: &Path) -> Result<()> {
    let native = root.join(".native/mujoco");
    folder(&to.join("lib"))?;
    for entry in fs::read_dir(native.join("lib"))? {
        let entry = entry?;
        let name = entry.file_name();
        // The plain name is for linkers.
        if name != "libmujoco.so" {
            copy(&entry.path(), &to.join("lib").join(name))?;
        }
    }
    copy_folder(&native.join("suite"), &to.join("suite"))
}

/// The libraries of `.native` that the dynamic loader takes for `binary`, those of libraries included.
fn native_libraries(root: &Path, binary: &Path) -> Result<Vec<PathBuf>> {
    let mut ldd = Command::new("ldd");
    with_native(ldd.arg(binary), root);
    let printed = String::from_utf8(output(&mut ldd)?)?;
    ensure!(
        !printed.contains("not found"),
        "a library of {} is missing:\n{printed}",
        binary.display()
    );
    Ok(parse_ldd(&printed, &root.join(".native")))
}

/// The paths within `native` among those that ldd printed.
fn parse_ldd(printed: &str, native: &Path) -> Vec<PathBuf> {
    printed
        .lines()
        .filter_map(|line| line.split_once(" => ")?.1.split(" (0x").next())
        .map(PathBuf::from)
        .filter(|path| path.starts_with(native))
        .collect()
}

fn strip(how: &str, from: &Path, to: &Path) -> Result<()> {
    folder(to.parent().context("a file without a folder")?)?;
    run(Command::new("strip").arg(how).arg("-o").arg(to).arg(from))
}

fn copy_folder(from: &Path, to: &Path) -> Result<()> {
    folder(to)?;
    for entry in fs::read_dir(from).with_context(|| format!("cannot read {}", from.display()))? {
        let entry = entry?;
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy_folder(&entry.path(), &target)?;
        } else {
            copy(&entry.path(), &target)?;
        }
    }
    Ok(())
}

fn copy(from: &Path, to: &Path) -> Result<()> {
    fs::copy(from, to).with_context(|| format!("cannot copy {}", from.display()))?;
    Ok(())
}

fn folder(path: &Path) -> Result<()> {
    fs::create_dir_all(path).with_context(|| format!("cannot create {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_ldd_prints_is_understood() {
        let printed = "\tlinux-vdso.so.1 (0x00007f23030ff000)\n\
                       \tlibtorch_cpu.so => /a b/.native/libtorch/lib/libtorch_cpu.so (0x00007f22ec800000)\n\
                       \tlibc.so.6 => /lib/x86_64-linux-gnu/libc.so.6 (0x00007f22ec61e000)\n\
                       \t/lib64/ld-linux-x86-64.so.2 (0x00007f2303101000)\n";
        assert_eq!(
            parse_ldd(printed, Path::new("/a b/.native")),
            [PathBuf::from("/a b/.native/libtorch/lib/libtorch_cpu.so")]
        );
    }
}
