//! Our client drives dm_control in Python over the protocol; both come from PyPI the first time.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use isodream_envs::{EndReason, EnvError, Environment, RemoteFault};
use isodream_rpc::{RemoteEnvironment, RemoteOptions};

const PACKAGES: &[&str] = &[
    "dm-control==1.0.50",
    "mujoco==3.17.0",
    "grpcio-tools==1.85.1",
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../..")
        .canonicalize()
        .unwrap()
}

/// Python with [`PACKAGES`], in a virtual environment of its own, made once.
fn python() -> PathBuf {
    let folder = root().join(".native/python-env");
    let python = folder.join("bin/python");
    let (done, wanted) = (folder.join("complete"), PACKAGES.join(" "));
    if std::fs::read_to_string(&done).ok().as_deref() != Some(&wanted) {
        let run = |command: &mut Command| assert!(command.status().unwrap().success());
        run(Command::new("python3")
            .args(["-m", "venv", "--clear"])
            .arg(&folder));
        run(Command::new(&python)
            .args(["-m", "pip", "install", "--quiet"])
            .args(PACKAGES));
        std::fs::write(&done, wanted).unwrap();
    }
    python
}

/// The Python server, killed when the value ends.
struct Server {
    process: Child,
    address: String,
}

impl Server {
    fn start(python: &Path, seconds_per_step: &str) -> Self {
        let mut process = Command::new(python)
            .arg(root().join("tests/python/serve_dm_control.py"))
            .arg(root().join("proto"))
            .arg(seconds_per_step)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut port = String::new();
        let mut output = BufReader::new(process.stdout.take().unwrap());
        output.read_line(&mut port).unwrap();
        let address = format!("127.0.0.1:{}", port.trim());
        Self { process, address }
    }

    fn connect(&self, deadline: Duration) -> RemoteEnvironment {
        let options = RemoteOptions {
            deadline,
            ..RemoteOptions::default()
        };
        RemoteEnvironment::connect(&isodream_rpc::Dialer::default(), &self.address, options)
            .unwrap()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

#[test]
fn dm_control_in_python_is_driven_and_its_death_is_noticed() {
    let python = python();
    let mut server = Server::start(&python, "0");
    let mut env = server.connect(Duration::from_secs(30));
    let spec = env.spec().clone();
    assert_eq!(
        (spec.action_dim, spec.action_repeat, spec.time_limit),
        (6, 2, 500)
    );
    let first = env.reset(1).unwrap();
    assert_eq!(first.image.len(), spec.image.bytes());

    let mut score = 0.0;
    let started = Instant::now();
    for step in 1..=spec.time_limit {
        let wave = (step as f32 * 0.3).sin();
        let row = env.step(&[wave, -wave, 0.2, -wave, wave, 0.1]).unwrap();
        assert!(row.reward.is_finite() && (0.0..=2.0).contains(&row.reward));
        assert_ne!(row.image, first.image);
        assert_eq!(row.is_last, step == spec.time_limit);
        score += row.reward;
    }
    println!(
        "{:.0} steps/s",
        f64::from(spec.time_limit) / started.elapsed().as_secs_f64()
    );
    assert!(score > 1.0, "{score}");
    assert_eq!(env.metrics()[0].0, "speed_m_s");
    assert_eq!(env.step(&[0.0; 6]), Err(EnvError::EpisodeOver));
    let again = env.reset(1).unwrap();
    assert_eq!(again.image, first.image, "the same seed begins differently");
    assert_eq!(again.end_reason, None::<EndReason>);

    server.process.kill().unwrap();
    let killed = Instant::now();
    let error = (0..100).find_map(|_| env.step(&[0.0; 6]).err()).unwrap();
    assert!(
        killed.elapsed() < Duration::from_secs(5),
        "{:?}",
        killed.elapsed()
    );
    assert!(
        matches!(
            &error,
            EnvError::Remote {
                fault: RemoteFault::Lost(_),
                ..
            }
        ),
        "{error}"
    );

    let slow = Server::start(&python, "60");
    let mut env = slow.connect(Duration::from_secs(10));
    env.reset(1).unwrap();
    let error = env.step(&[0.0; 6]).unwrap_err();
    assert!(
        matches!(
            &error,
            EnvError::Remote {
                fault: RemoteFault::Deadline(_),
                ..
            }
        ),
        "{error}"
    );
}
