//! Connections to servers.

use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use isodream_proto::v1::environment_service_client::EnvironmentServiceClient;
use isodream_proto::v1::learner_service_client::LearnerServiceClient;
use isodream_proto::v1::replay_service_client::ReplayServiceClient;
use tokio::time::timeout;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use crate::error::words;
use crate::limits::{
    CONNECT_TIMEOUT, CONNECTION_WINDOW_BYTES, KEEPALIVE_INTERVAL, KEEPALIVE_TIMEOUT,
    MAX_FRAME_BYTES, MAX_MESSAGE_BYTES, STATUS_TIMEOUT, STREAM_WINDOW_BYTES,
};
use crate::network::{leads_to, resolve_all};
use crate::{Bearer, Credentials, Network, RpcError, Tcp};

/// A connection that shows its token with every call.
pub type Wire = InterceptedService<Channel, Bearer>;

/// A client of a replay-server.
pub type ReplayClient = ReplayServiceClient<Wire>;

/// A client of a learner.
pub type LearnerClient = LearnerServiceClient<Wire>;

/// How a process reaches servers: over which network, and with what [`Credentials`].
///
/// The default is plain TCP without a token.
#[derive(Clone)]
pub struct Dialer {
    network: Arc<dyn Network>,
    credentials: Credentials,
    /// The names behind numeric addresses, which is what certificates are made out to.
    names: Arc<Mutex<HashMap<String, String>>>,
}

impl Default for Dialer {
    fn default() -> Self {
        Self::new(Credentials::default())
    }
}

impl fmt::Debug for Dialer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Dialer")
            .field("credentials", &self.credentials)
            .finish_non_exhaustive()
    }
}

impl Dialer {
    /// A dialer over the machine's own network.
    pub fn new(credentials: Credentials) -> Self {
        Self {
            network: Arc::new(Tcp),
            credentials,
            names: Arc::default(),
        }
    }

    /// A dialer over any network, without credentials.
    pub fn over(network: Arc<dyn Network>) -> Self {
        Self {
            network,
            credentials: Credentials::default(),
            names: Arc::default(),
        }
    }

    /// `addresses` with every name that stands for several servers replaced by all of them.
    pub(crate) async fn resolve(&self, addresses: &[String]) -> Vec<String> {
        let found = resolve_all(self.network.as_ref(), addresses).await;
        let mut names = self.names.lock().unwrap_or_else(PoisonError::into_inner);
        found
            .into_iter()
            .map(|(server, name)| {
                if server != name {
                    names.insert(server.clone(), name);
                }
                server
            })
            .collect()
    }

    /// Whether one of `addresses` leads to `address`, as far as that can be found out.
    pub(crate) async fn leads_to(&self, addresses: &[String], address: &str) -> bool {
        let looked_up = leads_to(self.network.as_ref(), addresses, address);
        timeout(STATUS_TIMEOUT, looked_up).await.unwrap_or(true)
    }

    /// The host of the name that `address` was found under, if it was.
    fn host_of(&self, address: &str) -> Option<String> {
        let names = self.names.lock().unwrap_or_else(PoisonError::into_inner);
        let name = names.get(address)?;
        Some(name.rsplit_once(':')?.0.to_owned())
    }

    /// A connection to `address` (`host:port`), made at the first call and again after every loss.
    ///
    /// # Errors
    /// [`RpcError::Address`] where `address` cannot be one, [`RpcError::Tls`] where certificates make no sense.
    ///
    /// # Panics
    /// Outside a tokio runtime.
    pub fn wire(&self, address: &str) -> Result<Wire, RpcError> {
        let invalid = |reason: String| RpcError::Address {
            address: address.to_owned(),
            reason,
        };
        if address.contains("://") {
            return Err(invalid(
                "the protocol is not a part of it: certificates decide whether TLS is spoken"
                    .to_owned(),
            ));
        }
        let scheme = match self.credentials.tls() {
            Some(_) => "https",
            None => "http",
        };
        let endpoint = Endpoint::from_shared(format!("{scheme}://{address}"))
            .map_err(|error| invalid(error.to_string()))?;
        if endpoint.uri().port().is_none() {
            return Err(invalid("the port is missing".to_owned()));
        }
        let mut endpoint = endpoint
            .connect_timeout(CONNECT_TIMEOUT)
            .http2_keep_alive_interval(KEEPALIVE_INTERVAL)
            .keep_alive_timeout(KEEPALIVE_TIMEOUT)
            .keep_alive_while_idle(true)
            .initial_stream_window_size(STREAM_WINDOW_BYTES)
            .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
            .max_frame_size(MAX_FRAME_BYTES)
            .tcp_nodelay(true);
        if let Some(tls) = self.credentials.tls() {
            let tls = match self.host_of(address) {
                Some(host) => tls.clone().domain_name(host),
                None => tls.clone(),
            };
            endpoint = endpoint
                .tls_config(tls)
                .map_err(|error| RpcError::tls(&error))?;
        }
        let channel = self.network.channel(&endpoint);
        Ok(Wire::new(channel, self.credentials.bearer()))
    }

    /// Asks the server at `address` whether all of it serves; that needs no token.
    ///
    /// # Errors
    /// As [`Dialer::wire`]; [`RpcError::Unhealthy`] where it does not serve, or does not answer within `limit`.
    pub async fn check_health(&self, address: &str, limit: Duration) -> Result<(), RpcError> {
        let unhealthy = |reason: String| RpcError::Unhealthy {
            address: address.to_owned(),
            reason,
        };
        let mut client = HealthClient::new(self.wire(address)?);
        let asked = client.check(HealthCheckRequest::default());
        let answer = timeout(limit, asked)
            .await
            .map_err(|_| unhealthy(format!("no answer came within {limit:?}")))?
            .map_err(|status| unhealthy(words(&status)))?;
        match answer.into_inner().status() {
            ServingStatus::Serving => Ok(()),
            other => Err(unhealthy(format!(
                "its status is {}",
                other.as_str_name().to_lowercase()
            ))),
        }
    }

    /// A client of the replay service at `address`.
    ///
    /// # Errors
    /// As [`Dialer::wire`].
    pub fn replay(&self, address: &str) -> Result<ReplayClient, RpcError> {
        Ok(ReplayServiceClient::new(self.wire(address)?)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES))
    }

    /// A client of the learner service at `address`.
    ///
    /// # Errors
    /// As [`Dialer::wire`].
    pub fn learner(&self, address: &str) -> Result<LearnerClient, RpcError> {
        Ok(LearnerServiceClient::new(self.wire(address)?)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES))
    }

    /// A client of the environment service at `address`.
    ///
    /// # Errors
    /// As [`Dialer::wire`].
    pub(crate) fn environment(
        &self,
        address: &str,
    ) -> Result<EnvironmentServiceClient<Wire>, RpcError> {
        Ok(EnvironmentServiceClient::new(self.wire(address)?)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn addresses_are_checked_by_name() {
        let dialer = Dialer::default();
        assert!(dialer.wire("localhost:7070").is_ok());
        assert!(dialer.wire("[::1]:7070").is_ok());
        for bad in ["localhost", "", "not an address:1", "http://host:1"] {
            let error = dialer.wire(bad).err().map(|error| error.to_string());
            assert!(
                error.is_some_and(|error| error.contains("host:port")),
                "{bad}"
            );
        }
    }
}
