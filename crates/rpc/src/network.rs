//! The seam under all clients of replay: how a server is reached.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;

use tonic::transport::{Channel, Endpoint};

/// The addresses of a name, as they come.
pub type Resolving = Pin<Box<dyn Future<Output = io::Result<Vec<SocketAddr>>> + Send>>;

/// How clients reach servers: over TCP, or over a simulated network in tests.
pub trait Network: Send + Sync + 'static {
    /// A channel that connects at its first call and again after every loss.
    fn channel(&self, endpoint: &Endpoint) -> Channel;

    /// All addresses of `address` (`host:port`).
    fn resolve(&self, address: String) -> Resolving;
}

/// The machine's own network.
#[derive(Debug, Clone, Copy)]
pub struct Tcp;

impl Network for Tcp {
    fn channel(&self, endpoint: &Endpoint) -> Channel {
        endpoint.connect_lazy()
    }

    fn resolve(&self, address: String) -> Resolving {
        Box::pin(async move { Ok(tokio::net::lookup_host(address).await?.collect()) })
    }
}

/// `addresses` with every name that stands for several servers replaced by all of them, in a stable order, and
/// beside each the name that it was found under.
///
/// A name with one address stays a name, so that it is looked up again at each connection; one that cannot be
/// resolved stays as well, and connecting to it says why. Of two address families only IPv4 counts, or a
/// server that listens on both would be two.
pub(crate) async fn resolve_all(
    network: &dyn Network,
    addresses: &[String],
) -> Vec<(String, String)> {
    let mut all: Vec<(String, String)> = Vec::new();
    for address in addresses {
        let found = network.resolve(address.clone()).await.unwrap_or_default();
        let has_v4 = found.iter().any(SocketAddr::is_ipv4);
        let mut servers: Vec<String> = found
            .iter()
            .filter(|found| found.is_ipv4() || !has_v4)
            .map(ToString::to_string)
            .collect();
        servers.sort();
        servers.dedup();
        if servers.len() < 2 {
            servers = vec![address.clone()];
        }
        for server in servers {
            if !all.iter().any(|(known, _)| *known == server) {
                all.push((server, address.clone()));
            }
        }
    }
    all
}

/// Whether one of `addresses` leads to `address`, or may do so: it cannot be looked up.
pub(crate) async fn leads_to(network: &dyn Network, addresses: &[String], address: &str) -> bool {
    for name in addresses {
        let leads_there = match network.resolve(name.clone()).await {
            Ok(found) => found.iter().any(|found| found.to_string() == address),
            Err(_) => true,
        };
        if leads_there || name == address {
            return true;
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Names;

    impl Network for Names {
        fn channel(&self, endpoint: &Endpoint) -> Channel {
            endpoint.connect_lazy()
        }

        fn resolve(&self, address: String) -> Resolving {
            let found: &[&str] = match address.as_str() {
                "replay:1" => &["10.0.0.2:1", "10.0.0.1:1", "[fd00::1]:1"],
                "localhost:1" => &["[::1]:1", "127.0.0.1:1"],
                "broken:1" => return Box::pin(async { Err(io::ErrorKind::TimedOut.into()) }),
                _ => &[],
            };
            let found = found
                .iter()
                .filter_map(|found| found.parse().ok())
                .collect();
            Box::pin(async move { Ok(found) })
        }
    }

    #[tokio::test]
    async fn names_of_several_servers_are_all_of_them_and_others_stay() {
        let addresses = ["unknown:1", "replay:1", "localhost:1", "10.0.0.1:1"].map(str::to_owned);
        let found = resolve_all(&Names, &addresses).await;
        let expected = [
            ("unknown:1", "unknown:1"),
            ("10.0.0.1:1", "replay:1"),
            ("10.0.0.2:1", "replay:1"),
            ("localhost:1", "localhost:1"),
        ];
        assert_eq!(
            found,
            expected.map(|(server, name)| (server.to_owned(), name.to_owned()))
        );
    }

    #[tokio::test]
    async fn a_name_leads_where_it_says_and_anywhere_while_it_cannot_be_asked() {
        let leads = async |names: &[&str], address| {
            let names: Vec<_> = names.iter().map(|name| (*name).to_owned()).collect();
            leads_to(&Names, &names, address).await
        };
        assert!(leads(&["replay:1"], "10.0.0.2:1").await);
        assert!(leads(&["replay:1", "10.0.0.9:1"], "10.0.0.9:1").await);
        assert!(!leads(&["replay:1", "localhost:1"], "10.0.0.9:1").await);
        assert!(leads(&["replay:1", "broken:1"], "10.0.0.9:1").await);
    }
}
