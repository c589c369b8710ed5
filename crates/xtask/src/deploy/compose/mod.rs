//! `cargo xtask deploy compose`: `deploy/compose/compose.yaml` run for real, and through what it must survive.

mod dashboard;
mod faults;
mod project;
mod table;
mod watch;

use std::fs;
use std::net::TcpListener;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::Path;
use std::process;
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use clap::Args;

use self::project::{Project, give_to_containers, inspect};
use self::table::Table;
use self::watch::{REPLAY_DIR, Watch, get, has_steps_of, wait};
use crate::docker::{self, docker, quiet};
use crate::image::{self, BuildArgs, Image};
use crate::run::target_dir;
use crate::stage::stage;

/// Options of `cargo xtask deploy compose`.
#[derive(Debug, Args)]
pub(crate) struct ComposeArgs {
    #[command(flatten)]
    images: BuildArgs,
    /// Take the images of these names as they are, instead of building them.
    #[arg(long)]
    built: bool,
}

/// More than the test will ever make.
const CONFIGURATION: &str = "[learner]\nenv_frames = 100_000_000\n";

/// What the roles may use; a process that is to meet its limit must fill it.
const LIMITS: [(&str, &str); 3] = [
    ("REPLAY_MEMORY", "512m"),
    ("LEARNER_MEMORY", "1g"),
    ("ACTOR_MEMORY", "512m"),
];

/// Runs the composition with the debug preset through everything that it must survive.
pub(crate) fn compose(root: &Path, args: &ComposeArgs) -> Result<()> {
    ensure!(
        fs::metadata("/proc/self").is_ok_and(|process| process.uid() == 0),
        "this test kills processes inside of containers: run it as root, on the machine of the Docker daemon"
    );
    if args.built {
        docker::daemon()?;
    } else {
        image::build_all(root, &args.images)?;
    }
    let mut project = prepare(root, &args.images)?;
    let mut table = Table::default();
    let result = survive(root, &project, &mut table);
    table.print();
    if result.is_err() {
        let logs = project
            .compose(&["logs", "--no-color", "--tail=15"])
            .output()?;
        eprintln!("{}", String::from_utf8_lossy(&logs.stdout));
    }
    result?;
    stage("down -v leaves nothing behind", || project.remove())
}

/// Secrets, settings, and the composition that will use them.
fn prepare(root: &Path, images: &BuildArgs) -> Result<Project> {
    let name = format!("isodream-test-{}", process::id());
    let folder = target_dir(root)?.join("deploy").join(&name);
    // The keys are for the containers' user alone; only root comes this far anyway.
    fs::DirBuilder::new()
        .recursive(true)
        .mode(0o700)
        .create(&folder)
        .with_context(|| format!("cannot create {}", folder.display()))?;
    let (secrets, configuration) = (folder.join("secrets"), folder.join("run.toml"));
    let path = |path: &Path| path.display().to_string();
    let mut environment = vec![
        ("ISODREAM_PREFIX", images.prefix.clone()),
        ("ISODREAM_TAG", images.tag.clone()),
        ("ISODREAM_PRESET", "debug".into()),
        ("ISODREAM_CONFIG", path(&configuration)),
        ("ISODREAM_SECRETS", path(&secrets)),
    ];
    // Any that is free: others may show their runs on this machine.
    let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    environment.push(("DASHBOARD_PORT", port.to_string()));
    environment.extend(LIMITS.map(|(name, value)| (name, value.into())));
    let file = root.join("deploy/compose/compose.yaml");
    let project = Project::new(name, file, folder, environment)?;

    fs::write(&configuration, CONFIGURATION)?;
    fs::create_dir(&secrets)?;
    give_to_containers(&secrets)?;
    let volume = format!("{}:/secrets", path(&secrets));
    let image = images.tag(Image::ReplayServer);
    let hosts = ["--host=replay", "--host=learner"];
    let make = ["run", "--rm", "--network=none", "--volume", &volume, &image];
    docker(&[&make[..], &["secrets", "/secrets"], &hosts].concat())?;
    Ok(project)
}

fn survive(root: &Path, project: &Project, table: &mut Table) -> Result<()> {
    let mut watch = Watch::new(project);
    stage("up, with 2 actors", || {
        let begun = Instant::now();
        project.up(2)?;
        let progress = wait("first updates", || watch.first())?;
        table.add("up, 2 actors: first updates", begun, None, progress);
        Ok(())
    })?;
    stage("strangers are refused", || strangers(project))?;
    stage("the page shows the run to who has the token", || {
        page(project)
    })?;
    stage("the dashboard's metrics exist", || {
        let served = watch
            .metrics()
            .context("the replay-server serves no metrics")?;
        dashboard::check(root, &served)
    })?;
    for actors in [4, 1] {
        stage(&format!("scale to {actors} actors"), || {
            scale(project, &mut watch, actors, table)
        })?;
    }
    for service in ["replay", "learner", "actor"] {
        stage(&format!("kill -9 of the {service}"), || {
            faults::kill(project, &mut watch, service, table)
        })?;
    }
    for service in ["replay", "learner", "actor"] {
        stage(&format!("the {service} is out of memory"), || {
            faults::out_of_memory(project, &mut watch, service, table)
        })?;
    }
    stage("stop, verify, start", || {
        restart(project, &mut watch, table)
    })
}

/// Neither without a certificate nor without encryption does anybody get an answer.
fn strangers(project: &Project) -> Result<()> {
    let replay = project.container("replay")?;
    let ask = |files: &[&str]| {
        // As one who has nothing but these files.
        let alone = ["exec", &replay, "env", "--unset=ISODREAM_SECRETS"];
        let ask = ["/usr/local/bin/isodream", "health", "localhost:7001"];
        docker(&[&alone[..], &ask, files].concat())
    };
    let authority = "--tls-ca=/run/secrets/ca.pem";
    ask(&[
        authority,
        "--tls-cert=/run/secrets/client.pem",
        "--tls-key=/run/secrets/client.key",
    ])
    .context("a client with a certificate got no answer")?;
    ensure!(
        ask(&[authority]).is_err(),
        "a client without a certificate got an answer"
    );
    ensure!(ask(&[]).is_err(), "an unencrypted client got an answer");
    Ok(())
}

/// The page knows the run and its roles, and nobody sees it without the token.
fn page(project: &Project) -> Result<()> {
    let page = inspect(&project.container("dashboard")?)?;
    let address = format!(
        "{}:7080",
        page.address().context("the page has no address")?
    );
    let token = fs::read_to_string(project.folder.join("secrets/viewer.token"))?;
    let authorization = format!("Authorization: Bearer {}\r\n", token.trim());
    let runs = wait("a page that knows the run", || {
        // Not up yet counts as not knowing it.
        let runs = get(&address, "/api/runs", &authorization).unwrap_or_default();
        Ok(runs.contains("\"id\":\"run\"").then_some(runs))
    })?;
    ensure!(runs.contains("\"live\":true"), "{runs}");
    let live = get(&address, "/api/live", &authorization)?;
    ensure!(
        live.contains("\"up\":true") && live.contains("\"updates\":"),
        "the page does not know the roles: {live}"
    );
    let stranger = get(&address, "/api/runs", "")?;
    ensure!(stranger.contains(" 401 "), "{stranger}");
    Ok(())
}

/// Scales, and waits until every actor has stored steps under a name of its own.
fn scale(project: &Project, watch: &mut Watch<'_>, actors: usize, table: &mut Table) -> Result<()> {
    let before = watch.progress()?;
    let (begun, since) = (Instant::now(), faults::now()?);
    project.up(actors)?;
    let running = project.containers("actor")?;
    ensure!(
        running.len() == actors,
        "{} actors run, not {actors}",
        running.len()
    );
    for code in faults::exit_codes(project, since, "actor")? {
        ensure!(code == 0, "an actor that was stopped ended with {code}");
    }
    let replay = project.container("replay")?;
    for id in &running {
        let actor = inspect(id)?;
        let name = actor.host_name().context("a container without a name")?;
        wait("steps of every actor", || {
            Ok(has_steps_of(&replay, name)?.then_some(()))
        })?;
    }
    let after = watch.beyond(before)?;
    let what = format!("scale to {actors}: all insert");
    table.add(&what, begun, Some(before), after);
    Ok(())
}

/// Stops all roles in an orderly way, reads every byte that was stored, and starts them again.
fn restart(project: &Project, watch: &mut Watch<'_>, table: &mut Table) -> Result<()> {
    let before = watch.progress()?;
    quiet(&mut project.compose(&["stop"]))?;
    for service in ["replay", "learner", "actor", "evaluator"] {
        let code = inspect(&project.container(service)?)?.exit_code();
        ensure!(
            code == Some(0),
            "the {service} ended with {code:?} when it was stopped"
        );
    }
    let volume = format!("{}:/var/lib/isodream", project.volume("replay"));
    let replay = inspect(&project.container("replay")?)?;
    let image = replay.image().context("a container without an image")?;
    let run = ["run", "--rm", "--network=none", "--volume", &volume, image];
    let verified = docker(&[&run[..], &["replay", "verify", REPLAY_DIR]].concat())?;
    eprintln!("xtask: replay verify: {}", verified.trim());
    let begun = Instant::now();
    project.up(1)?;
    let after = watch.beyond(before)?;
    table.add("start after a stop", begun, Some(before), after);
    Ok(())
}
