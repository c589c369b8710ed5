//! `cargo xtask image`: the container images of the roles, from binaries that are built on this machine.

mod binaries;
mod context;

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result};
use clap::{Args, ValueEnum};

use self::binaries::Binaries;
use crate::docker;
use crate::stage::{output, run, stage};

/// Options of `cargo xtask image`.
#[derive(Debug, Args)]
pub(crate) struct ImageArgs {
    /// The image that all others begin with; by default that of deploy/docker/Dockerfile.
    #[arg(long, value_name = "TAG", conflicts_with = "local_base")]
    base: Option<String>,
    /// Make the base from Debian's packages first (deploy/docker/base.sh; the first time as root).
    #[arg(long)]
    local_base: bool,
    /// One image instead of all.
    #[arg(long, value_name = "IMAGE")]
    only: Option<Image>,
    /// What the images' names begin with: a registry's address goes here.
    #[arg(long, default_value = "isodream-")]
    prefix: String,
    /// The images' tag.
    #[arg(long, default_value = "latest")]
    tag: String,
    #[command(flatten)]
    binaries: Binaries,
}

/// A target of the Dockerfile.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Image {
    ReplayServer,
    Actor,
    Learner,
}

impl Image {
    fn name(self) -> &'static str {
        match self {
            Self::ReplayServer => "replay-server",
            Self::Actor => "actor",
            Self::Learner => "learner",
        }
    }

    fn needs_torch(self) -> bool {
        self != Self::ReplayServer
    }
}

/// Builds the images, starts each once, and says how large they are.
pub(crate) fn image(root: &Path, args: &ImageArgs) -> Result<()> {
    docker::daemon()?;
    let base = if args.local_base {
        Some(stage("base image", || local_base(root))?)
    } else {
        args.base.clone()
    };
    let wanted: Vec<Image> = match args.only {
        Some(image) => vec![image],
        None => Image::value_variants().to_vec(),
    };
    let mut built = Vec::new();
    for needs_torch in [false, true] {
        let images: Vec<_> = wanted
            .iter()
            .filter(|image| image.needs_torch() == needs_torch)
            .collect();
        if images.is_empty() {
            continue;
        }
        let binary = args.binaries.find(root, needs_torch)?;
        let folder = stage("stage context", || {
            context::make(root, &binary, needs_torch)
        })?;
        for image in images {
            let tag = format!("{}{}:{}", args.prefix, image.name(), args.tag);
            stage(&tag, || {
                build(root, &folder, *image, base.as_deref(), &tag)?;
                starts(&tag)
            })?;
            built.push(tag);
        }
    }
    eprintln!("{:<44} {:>8}", "image", "MB");
    for tag in &built {
        eprintln!("{tag:<44} {:>8.1}", size(tag)? as f64 / 1e6);
    }
    Ok(())
}

/// The tag of the base image that the script makes.
fn local_base(root: &Path) -> Result<String> {
    const TAG: &str = "isodream-base:local";
    run(Command::new(root.join("deploy/docker/base.sh")).arg(TAG))?;
    Ok(TAG.into())
}

fn build(root: &Path, context: &Path, image: Image, base: Option<&str>, tag: &str) -> Result<()> {
    let dockerfile: PathBuf = root.join("deploy/docker/Dockerfile");
    let mut command = Command::new("docker");
    command.args(["build", "--quiet", "--target", image.name(), "--tag", tag]);
    command.arg("--file").arg(dockerfile);
    if let Some(base) = base {
        command.args(["--build-arg", &format!("BASE={base}")]);
    }
    output(command.arg(context)).map(drop)
}

/// Fails where the base lacks a library, or has an older one than the binary was linked with.
fn starts(tag: &str) -> Result<()> {
    let args = ["run", "--rm", "--network=none", tag, "--version"];
    let version = output(Command::new("docker").args(args)).context(
        "the image does not start: its base needs libgcc_s, libstdc++ and a glibc not older than this machine's",
    )?;
    eprint!("xtask: {}", String::from_utf8_lossy(&version));
    Ok(())
}

/// Bytes of all layers, the base's included.
fn size(tag: &str) -> Result<u64> {
    let args = ["image", "inspect", "--format", "{{.Size}}", tag];
    let printed = output(Command::new("docker").args(args))?;
    let printed = String::from_utf8(printed)?;
    printed
        .trim()
        .parse()
        .with_context(|| format!("docker says that the size of {tag} is {printed}"))
}
