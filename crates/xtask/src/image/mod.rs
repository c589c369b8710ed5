//! `cargo xtask image`: the container images of the roles, from binaries that are built on this machine.

mod binaries;
mod context;

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result};
use clap::{Args, ValueEnum};

use self::binaries::Binaries;
use crate::docker::{self, docker, quiet};
use crate::stage::{run, stage};

/// Options of `cargo xtask image`.
#[derive(Debug, Args)]
pub(crate) struct ImageArgs {
    /// One image instead of all.
    #[arg(long, value_name = "IMAGE")]
    only: Option<Image>,
    #[command(flatten)]
    build: BuildArgs,
}

/// What images are made of, and what they are called.
#[derive(Debug, Args)]
pub(crate) struct BuildArgs {
    /// The image that all others begin with; by default that of deploy/docker/Dockerfile.
    #[arg(long, value_name = "TAG", conflicts_with = "local_base")]
    base: Option<String>,
    /// Make the base from Debian's packages first (deploy/docker/base.sh; the first time as root).
    #[arg(long)]
    local_base: bool,
    /// What the images' names begin with: a registry's address goes here.
    #[arg(long, default_value = "isodream-")]
    pub(crate) prefix: String,
    /// The images' tag.
    #[arg(long, default_value = "latest")]
    pub(crate) tag: String,
    #[command(flatten)]
    binaries: Binaries,
}

impl BuildArgs {
    /// The whole name of an image.
    pub(crate) fn tag(&self, image: Image) -> String {
        format!("{}{}:{}", self.prefix, image.name(), self.tag)
    }
}

/// A target of the Dockerfile.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Image {
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

/// Builds what was asked for.
pub(crate) fn image(root: &Path, args: &ImageArgs) -> Result<()> {
    match args.only {
        Some(image) => build_some(root, &args.build, &[image]),
        None => build_all(root, &args.build),
    }
}

/// Builds all images, starts each once, and says how large they are.
pub(crate) fn build_all(root: &Path, args: &BuildArgs) -> Result<()> {
    build_some(root, args, Image::value_variants())
}

fn build_some(root: &Path, args: &BuildArgs, wanted: &[Image]) -> Result<()> {
    docker::daemon()?;
    let base = if args.local_base {
        Some(stage("base image", || local_base(root))?)
    } else {
        args.base.clone()
    };
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
            let tag = args.tag(*image);
            stage(&tag, || {
                build(root, &folder, *image, base.as_deref(), &tag)?;
                starts(&tag)
            })?;
        }
    }
    eprintln!("{:<44} {:>8}", "image", "MB");
    for image in wanted {
        let tag = args.tag(*image);
        eprintln!("{tag:<44} {:>8.1}", size(&tag)? as f64 / 1e6);
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
    quiet(command.arg(context)).map(drop)
}

/// Fails where the base lacks a library, or has an older one than the binary was linked with.
fn starts(tag: &str) -> Result<()> {
    let version = docker(&["run", "--rm", "--network=none", tag, "--version"]).context(
        "the image does not start: its base needs libgcc_s, libstdc++ and a glibc not older than this machine's",
    )?;
    eprint!("xtask: {version}");
    Ok(())
}

/// Bytes of all layers, the base's included.
fn size(tag: &str) -> Result<u64> {
    let printed = docker(&["image", "inspect", "--format", "{{.Size}}", tag])?;
    printed
        .trim()
        .parse()
        .with_context(|| format!("docker says that the size of {tag} is {printed}"))
}
