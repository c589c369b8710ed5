//! Run directories, a dashboard over them, and the plainest of HTTP clients.

use std::fs::{self, OpenOptions};
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};

use isodream_core::Config;
use isodream_dashboard::{Guard, Options, serve};
use isodream_telemetry::media::{EpisodeFacts, MediaFolder, OpenLoopFacts, ProbeFacts};
use isodream_telemetry::probe::{Probe, ProbedState};
use isodream_telemetry::{Rgb, encode_mp4};
use tokio_util::sync::{CancellationToken, DropGuard};

/// Makes a run of a seed with the values 1, 2, .. of `eval/score`.
pub(crate) fn run(root: &Path, name: &str, seed: u64, values: u32) -> PathBuf {
    let run = root.join(name);
    fs::create_dir_all(&run).unwrap();
    let config = Config {
        seed,
        ..Config::default()
    };
    fs::write(run.join("config.toml"), config.to_toml()).unwrap();
    for value in 1..=values {
        append(
            &run,
            &format!(
                "{{\"frames\":{},\"time\":1.0,\"eval/score\":{value}.0}}\n",
                100 * value
            ),
        );
    }
    run
}

/// Appends to the run's metrics as they are.
pub(crate) fn append(run: &Path, text: &str) {
    let path = run.join("metrics.jsonl");
    let mut file = OpenOptions::new()
        .create(true)
        .append(true)
        .open(path)
        .unwrap();
    file.write_all(text.as_bytes()).unwrap();
}

/// An episode of two steps, a panel and a probe.
pub(crate) fn media(run: &Path) {
    let folder = MediaFolder::create(run).unwrap();
    let frames = [10, 100, 200].map(|gray| Rgb::filled(32, 32, [gray; 3]));
    let episode = EpisodeFacts {
        frames: 300,
        updates: 9,
        score: 42.5,
        length: 2,
        end_reason: "time_limit".into(),
        fps: 5.0,
        window: 3,
        attention: vec![vec![0.2, 0.3, 0.5], vec![0.1, 0.1, 0.8]],
        gate: vec![0.0, 1.0],
    };
    folder
        .episode(&episode, &encode_mp4(&frames, 5.0).unwrap())
        .unwrap();
    let panel = OpenLoopFacts {
        frames: 200,
        updates: 7,
        context: 1,
        error: vec![0.01, 0.02, 0.03],
    };
    folder.open_loop(&panel, &frames[0], &frames, 5.0).unwrap();
    let state = |kind: &str, imagined: &[f64]| ProbedState {
        kind: kind.into(),
        real: vec![1.0, 2.0, 4.0],
        imagined: imagined.into(),
    };
    let probe = Probe {
        horizon: 15,
        plans: ["pedal 0", "pedal 0.5", "pedal 1"].map(String::from).into(),
        states: vec![
            state("contact", &[3.0, 2.0, 1.0]),
            state("free", &[1.0, 2.5, 3.0]),
        ],
    };
    folder
        .probe(&ProbeFacts {
            frames: 300,
            updates: 9,
            report: probe.report(),
            states: probe.states,
        })
        .unwrap();
}

/// A dashboard in a thread of its own, until it is dropped.
pub(crate) struct Server {
    pub(crate) address: SocketAddr,
    _stop: DropGuard,
}

impl Server {
    pub(crate) fn start(root: &Path, guard: Guard) -> Self {
        let stop = CancellationToken::new();
        let (options, stopped) = (
            Options {
                root: root.to_owned(),
                sources: None,
                guard,
            },
            stop.clone(),
        );
        let (tell, address) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            let runtime = tokio::runtime::Runtime::new().unwrap();
            runtime.block_on(async {
                let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
                tell.send(listener.local_addr().unwrap()).unwrap();
                serve(listener, options, stopped).await.unwrap();
            });
        });
        Self {
            address: address.recv().unwrap(),
            _stop: stop.drop_guard(),
        }
    }

    /// Status and body of a request under the server's own name.
    pub(crate) fn get(&self, path: &str) -> (u16, String) {
        let (status, _, body) = self.ask(path, &[("Host", &self.address.to_string())]);
        (status, String::from_utf8_lossy(&body).into_owned())
    }

    /// Status, head and body.
    pub(crate) fn ask(&self, path: &str, headers: &[(&str, &str)]) -> (u16, String, Vec<u8>) {
        let mut stream = TcpStream::connect(self.address).unwrap();
        let headers: String = headers
            .iter()
            .map(|(name, value)| format!("{name}: {value}\r\n"))
            .collect();
        write!(
            stream,
            "GET {path} HTTP/1.1\r\nConnection: close\r\n{headers}\r\n"
        )
        .unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let end = answer
            .windows(4)
            .position(|four| four == b"\r\n\r\n")
            .unwrap();
        let head = String::from_utf8(answer[..end].to_vec()).unwrap();
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        (status, head.to_lowercase(), answer[end + 4..].to_vec())
    }
}
