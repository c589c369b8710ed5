//! Connections to servers.

use isodream_proto::v1::learner_service_client::LearnerServiceClient;
use isodream_proto::v1::replay_service_client::ReplayServiceClient;
use tonic::transport::{Channel, Endpoint};

use crate::limits::{
    CONNECT_TIMEOUT, CONNECTION_WINDOW_BYTES, KEEPALIVE_INTERVAL, KEEPALIVE_TIMEOUT,
    MAX_FRAME_BYTES, MAX_MESSAGE_BYTES, STREAM_WINDOW_BYTES,
};
use crate::{Network, RpcError, Tcp};

/// A connection to `address` (`host:port`, with or without `http://`), made at the first call and again
/// after every loss.
///
/// # Errors
/// [`RpcError::Address`] where `address` cannot be one.
///
/// # Panics
/// Outside a tokio runtime.
pub fn channel(address: &str) -> Result<Channel, RpcError> {
    channel_over(&Tcp, address)
}

fn channel_over(network: &dyn Network, address: &str) -> Result<Channel, RpcError> {
    let uri = if address.contains("://") {
        address.to_owned()
    } else {
        format!("http://{address}")
    };
    let invalid = |reason: String| RpcError::Address {
        address: address.to_owned(),
        reason,
    };
    let endpoint = Endpoint::from_shared(uri).map_err(|error| invalid(error.to_string()))?;
    if endpoint.uri().port().is_none() {
        return Err(invalid("the port is missing".to_owned()));
    }
    let endpoint = endpoint
        .connect_timeout(CONNECT_TIMEOUT)
        .http2_keep_alive_interval(KEEPALIVE_INTERVAL)
        .keep_alive_timeout(KEEPALIVE_TIMEOUT)
        .keep_alive_while_idle(true)
        .initial_stream_window_size(STREAM_WINDOW_BYTES)
        .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
        .max_frame_size(MAX_FRAME_BYTES)
        .tcp_nodelay(true);
    Ok(network.channel(&endpoint))
}

/// A client of the replay service at `address`.
///
/// # Errors
/// As [`channel`].
pub fn replay_client(address: &str) -> Result<ReplayServiceClient<Channel>, RpcError> {
    replay_client_over(&Tcp, address)
}

/// [`replay_client`] over any network.
pub(crate) fn replay_client_over(
    network: &dyn Network,
    address: &str,
) -> Result<ReplayServiceClient<Channel>, RpcError> {
    Ok(ReplayServiceClient::new(channel_over(network, address)?)
        .max_decoding_message_size(MAX_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES))
}

/// A client of the learner service at `address`.
///
/// # Errors
/// As [`channel`].
pub fn learner_client(address: &str) -> Result<LearnerServiceClient<Channel>, RpcError> {
    Ok(LearnerServiceClient::new(channel(address)?)
        .max_decoding_message_size(MAX_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_MESSAGE_BYTES))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn addresses_are_checked_by_name() {
        assert!(channel("localhost:7070").is_ok());
        assert!(channel("http://[::1]:7070").is_ok());
        for bad in ["localhost", "", "not an address:1", "http://host"] {
            let error = channel(bad).err().map(|error| error.to_string());
            assert!(
                error.is_some_and(|error| error.contains("host:port")),
                "{bad}"
            );
        }
    }
}
