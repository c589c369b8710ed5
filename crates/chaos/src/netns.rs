//! Hosts as network namespaces on one bridge: `10.77.0.N`, a name each. Needs root and the `ip` command.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};

/// Address of the hub, from where servers are called.
const HUB_ADDRESS: &str = "10.77.0.254";

/// Hosts that reach each other and nothing else. Dropping it removes them.
#[derive(Debug)]
pub(crate) struct Network {
    /// Begins the names of all namespaces.
    prefix: String,
    /// Number of each host by its name.
    hosts: BTreeMap<String, usize>,
}

impl Network {
    /// Makes a host for each of `names`, and a hub with the bridge between them.
    pub(crate) fn new<'a>(names: impl IntoIterator<Item = &'a str>) -> Result<Self> {
        let mut network = Self {
            prefix: format!("chaos{}", std::process::id()),
            hosts: BTreeMap::new(),
        };
        let hub = network.namespace("hub");
        ip(&["netns", "add", &hub])?;
        for line in [
            "link set lo up",
            "link add br0 type bridge",
            "link set br0 up",
            &format!("addr add {HUB_ADDRESS}/24 dev br0"),
        ] {
            inside(&hub, line)?;
        }
        for (index, name) in names.into_iter().enumerate() {
            let number = index + 1;
            network.hosts.insert(name.to_owned(), number);
            let host = network.namespace(name);
            ip(&["netns", "add", &host])?;
            let port = format!("port{number}");
            inside(
                &hub,
                &format!("link add {port} type veth peer name eth0 netns {host}"),
            )?;
            inside(&hub, &format!("link set {port} master br0"))?;
            inside(&hub, &format!("link set {port} up"))?;
            inside(&host, "link set lo up")?;
            inside(&host, &format!("addr add 10.77.0.{number}/24 dev eth0"))?;
            inside(&host, "link set eth0 up")?;
        }
        Ok(network)
    }

    /// Address of the host `name`.
    pub(crate) fn address(&self, name: &str) -> Result<String> {
        Ok(format!("10.77.0.{}", self.number(name)?))
    }

    /// The file of the hub's namespace.
    pub(crate) fn hub(&self) -> PathBuf {
        self.file("hub")
    }

    /// The file of the namespace of the host `name`.
    pub(crate) fn host(&self, name: &str) -> Result<PathBuf> {
        self.number(name)?;
        Ok(self.file(name))
    }

    fn file(&self, name: &str) -> PathBuf {
        PathBuf::from("/run/netns").join(self.namespace(name))
    }

    /// What makes a command run on the host `name`.
    pub(crate) fn inside(&self, name: &str) -> Result<Vec<String>> {
        self.number(name)?;
        let words = ["ip", "netns", "exec"].map(str::to_owned);
        Ok([&words[..], &[self.namespace(name)]].concat())
    }

    /// Pulls out the host's cable, or puts it back in.
    pub(crate) fn link(&self, name: &str, is_up: bool) -> Result<()> {
        let state = if is_up { "up" } else { "down" };
        let line = format!("link set port{} {state}", self.number(name)?);
        inside(&self.namespace("hub"), &line)
    }

    /// Drops everything between two hosts without a word, or no more.
    pub(crate) fn cut(&self, one: &str, other: &str, is_cut: bool) -> Result<()> {
        let peer = self.address(other)?;
        let action = if is_cut { "-I" } else { "-D" };
        for (chain, direction) in [("INPUT", "-s"), ("OUTPUT", "-d")] {
            let words = [
                "iptables", "-w", action, chain, direction, &peer, "-j", "DROP",
            ];
            run_inside(&self.namespace(one), &words)?;
        }
        Ok(())
    }

    /// Lets the host send and receive only so fast (tbf: a token bucket with a queue), or as fast as it can.
    pub(crate) fn slow(&self, name: &str, kbit_s: Option<u32>) -> Result<()> {
        let port = format!("port{}", self.number(name)?);
        for (namespace, device) in [
            (self.namespace("hub"), port.as_str()),
            (self.namespace(name), "eth0"),
        ] {
            let rate = kbit_s.map(|kbit_s| format!("{kbit_s}kbit"));
            let words = match &rate {
                Some(rate) => vec![
                    "tc", "qdisc", "add", "dev", device, "root", "tbf", "rate", rate, "burst",
                    "16kb", "latency", "400ms",
                ],
                None => vec!["tc", "qdisc", "del", "dev", device, "root"],
            };
            run_inside(&namespace, &words)?;
        }
        Ok(())
    }

    fn number(&self, name: &str) -> Result<usize> {
        let number = self.hosts.get(name).copied();
        number.with_context(|| format!("the network has no host {name}"))
    }

    fn namespace(&self, name: &str) -> String {
        format!("{}-{name}", self.prefix)
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        for name in self.hosts.keys().map(String::as_str).chain(["hub"]) {
            // Its devices go with it.
            if let Err(error) = ip(&["netns", "del", &self.namespace(name)]) {
                eprintln!("{error:#}");
            }
        }
    }
}

/// `ip` in the namespace with the words of `line`.
fn inside(namespace: &str, line: &str) -> Result<()> {
    let words = ["-n", namespace].into_iter().chain(line.split(' '));
    ip(&words.collect::<Vec<_>>())
}

fn run_inside(namespace: &str, words: &[&str]) -> Result<()> {
    ip(&[&["netns", "exec", namespace], words].concat())
}

fn ip(words: &[&str]) -> Result<()> {
    let output = Command::new("ip")
        .args(words)
        .stdin(Stdio::null())
        .output()
        .context("cannot start ip; install iproute2 and iptables")?;
    if !output.status.success() {
        bail!(
            "`ip {}` failed: {}; hosts as network namespaces need root",
            words.join(" "),
            String::from_utf8_lossy(&output.stderr).trim()
        );
    }
    Ok(())
}
