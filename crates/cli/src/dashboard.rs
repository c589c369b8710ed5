//! `isodream dashboard`, and the page that `isodream train` opens.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use clap::Args;
use isodream_dashboard::{Guard, Options, Sources, serve};
use isodream_rpc::{Role, shutdown_on_signal};
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;

use crate::security::ClientArgs;

/// Ports after the asked one that are tried, so that several runs on a machine each have a page.
const PORTS: u16 = 20;

/// Options of `isodream dashboard`.
#[derive(Debug, Args)]
pub(crate) struct DashboardArgs {
    /// A run directory, or a folder of them
    #[arg(default_value = "runs")]
    runs: PathBuf,
    #[command(flatten)]
    page: PageArgs,
    /// The learner of a live run
    #[arg(long, requires = "replay")]
    learner: Option<String>,
    /// The replay-servers of a live run
    #[arg(long, value_delimiter = ',', requires = "learner")]
    replay: Vec<String>,
    #[command(flatten)]
    security: ClientArgs,
}

/// Where a page is, and who may see it.
#[derive(Debug, Clone, Args)]
pub(crate) struct PageArgs {
    /// Where the page is served; a port that is taken gives way to the next free one. `train` also takes `off`
    #[arg(
        long,
        value_name = "ADDR",
        default_value = "127.0.0.1:7080",
        env = "ISODREAM_DASHBOARD"
    )]
    dashboard_listen: String,
    /// File with the token that the page asks for, once, as ?token=
    #[arg(long, value_name = "FILE", env = "ISODREAM_DASHBOARD_TOKEN_FILE")]
    dashboard_token_file: Option<PathBuf>,
    /// Show the page to everybody who reaches it
    #[arg(long)]
    dashboard_insecure: bool,
}

/// A page that is about to be served.
#[derive(Debug)]
pub(crate) struct Page {
    listener: TcpListener,
    guard: Guard,
    address: SocketAddr,
}

impl PageArgs {
    /// [`Self::open`], unless the address is `off`.
    #[cfg(feature = "torch")]
    pub(crate) async fn open_unless_off(&self) -> anyhow::Result<Option<Page>> {
        match &*self.dashboard_listen {
            "off" => Ok(None),
            _ => self.open().await.map(Some),
        }
    }

    /// Finds a port.
    ///
    /// # Errors
    /// Where the address is none, no port is free, or nothing guards a page that others can reach.
    pub(crate) async fn open(&self) -> anyhow::Result<Page> {
        let asked = tokio::net::lookup_host(&self.dashboard_listen)
            .await
            .with_context(|| {
                format!(
                    "--dashboard-listen {}: write host:port, for example 127.0.0.1:7080",
                    self.dashboard_listen
                )
            })?
            .next()
            .context("--dashboard-listen: the name resolves to nothing")?;
        let guard = Guard::new(
            asked,
            self.dashboard_token_file.as_deref(),
            self.dashboard_insecure,
        )?;
        let mut last = None;
        for port in asked.port()..=asked.port().saturating_add(PORTS) {
            match TcpListener::bind(SocketAddr::new(asked.ip(), port)).await {
                Ok(listener) => {
                    let address = listener.local_addr()?;
                    return Ok(Page {
                        listener,
                        guard,
                        address,
                    });
                }
                Err(error) => last = Some(error),
            }
        }
        let why = last.map_or_else(String::new, |error| error.to_string());
        anyhow::bail!("cannot serve the dashboard at {asked} or the {PORTS} ports after it: {why}")
    }
}

impl Page {
    /// Where a browser finds it.
    pub(crate) fn url(&self) -> String {
        format!("http://{}/", self.address)
    }

    /// Serves until `shutdown`.
    pub(crate) async fn serve(
        self,
        root: &Path,
        sources: Option<Sources>,
        shutdown: CancellationToken,
    ) -> anyhow::Result<()> {
        let options = Options {
            root: root.to_owned(),
            sources,
            guard: self.guard,
        };
        serve(self.listener, options, shutdown)
            .await
            .context("the dashboard failed")
    }
}

/// Runs the command.
pub(crate) async fn run(args: DashboardArgs) -> anyhow::Result<()> {
    ensure!(
        args.runs.is_dir(),
        "{} is no folder; give a run directory or a folder of them",
        args.runs.display()
    );
    let sources = match args.learner {
        Some(learner) => Some(Sources {
            dialer: args.security.dialer(Role::Viewer)?,
            learner,
            replay: args.replay,
        }),
        None => None,
    };
    let page = args.page.open().await?;
    eprintln!("dashboard of {} at {}", args.runs.display(), page.url());
    page.serve(&args.runs, sources, shutdown_on_signal()?).await
}
