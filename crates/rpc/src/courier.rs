//! Brings a store what it was sent before the client left it for another one.

use std::sync::Arc;

use tokio::time::{Instant, sleep};

use crate::append_link::{Achieved, AppendLink, LinkEnd, Purpose, Sender};
use crate::backoff::delays;
use crate::error::words;
use crate::limits::{LAST_LEFTOVERS_DELAY, LEFTOVERS_DELAYS};
use crate::link_state::LinkState;
use crate::spool::Spool;
use crate::{Dialer, RpcError};

/// Looks for a store wherever the client's replay-servers are, for as long as it is owed chunks: a server that comes
/// back may have another address, and at its old one may be another store by then.
pub(crate) struct Courier {
    pub(crate) dialer: Dialer,
    pub(crate) addresses: Vec<String>,
    pub(crate) sender: Arc<Sender>,
    pub(crate) spool: Arc<Spool>,
    pub(crate) store_id: String,
}

impl Courier {
    /// Returns when nothing is left to bring or the client turned to the store itself; else why the store refuses
    /// the client for good.
    pub(crate) async fn run(self) -> Result<(), RpcError> {
        let store_id = &self.store_id;
        tracing::warn!(store_id, "chunks wait for a store that was left");
        let mut pauses = delays(LEFTOVERS_DELAYS);
        loop {
            for address in self.dialer.resolve(&self.addresses).await {
                if self.visit(&address).await? {
                    pauses = delays(LEFTOVERS_DELAYS);
                }
                if !self.spool.is_left_behind(store_id) {
                    tracing::info!(store_id, "it is not left behind any more");
                    return Ok(());
                }
            }
            let pause = sleep(pauses.next().unwrap_or_default());
            let hurried = async {
                self.spool.closed().await;
                sleep(LAST_LEFTOVERS_DELAY).await;
            };
            tokio::select! {
                () = pause => {}
                () = hurried => {}
            }
        }
    }

    /// Whether the server at `address` acknowledged anything.
    async fn visit(&self, address: &str) -> Result<bool, RpcError> {
        let client = match self.dialer.replay(address) {
            Ok(client) => client,
            Err(error) => {
                tracing::debug!(address, %error, "leftovers wait");
                return Ok(false);
            }
        };
        let link = AppendLink {
            client,
            sender: self.sender.clone(),
            spool: self.spool.clone(),
            state: Arc::new(LinkState::new(address)),
            purpose: Purpose::Leftovers(self.store_id.clone()),
        };
        let mut achieved = Achieved::default();
        match link.connection(Instant::now(), &mut achieved).await {
            Ok(LinkEnd::Refused(error)) => return Err(error),
            Ok(LinkEnd::Away | LinkEnd::Empty) => {}
            Err(status) => {
                let why = words(&status);
                tracing::debug!(address, store_id = self.store_id, why, "leftovers wait");
            }
        }
        Ok(achieved.progressed)
    }
}
