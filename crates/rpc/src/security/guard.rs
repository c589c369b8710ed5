//! The check in front of every call.

use std::collections::HashMap;
use std::pin::Pin;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::task::{Context, Poll};

use http::{Request, Response};
use tonic::Status;
use tonic::body::Body;
use tonic::transport::server::TlsConnectInfo;
use tower_layer::Layer;
use tower_service::Service;

use super::Tokens;
use super::admission::Admission;
use super::tokens::Grant;

/// Whoever watches over servers need not be known to them.
const HEALTH: &str = "/grpc.health.v1.Health/";

/// Puts the check of tokens and limits before a service.
#[derive(Debug, Clone)]
pub struct GuardLayer(Arc<Rules>);

#[derive(Debug)]
struct Rules {
    tokens: Option<Tokens>,
    max_connections: usize,
    /// Open connections by token; `None` counts those without one.
    open: Arc<Mutex<HashMap<Option<Grant>, usize>>>,
}

impl GuardLayer {
    pub(super) fn new(tokens: Option<Tokens>, max_connections: usize) -> Self {
        Self(Arc::new(Rules {
            tokens,
            max_connections,
            open: Arc::default(),
        }))
    }

    /// As a first call that is allowed does.
    #[cfg(test)]
    pub(super) fn let_in(&self, ticket: &Ticket) {
        ticket.take(&self.0, None).expect("there is room");
    }
}

impl<S> Layer<S> for GuardLayer {
    type Service = Guard<S>;

    fn layer(&self, inner: S) -> Guard<S> {
        Guard {
            rules: self.0.clone(),
            inner,
        }
    }
}

/// Lets calls through whose token allows them.
#[derive(Debug, Clone)]
pub struct Guard<S> {
    rules: Arc<Rules>,
    inner: S,
}

impl<S> Service<Request<Body>> for Guard<S>
where
    S: Service<Request<Body>, Response = Response<Body>>,
    S::Future: Send + 'static,
    S::Error: Send + 'static,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Pin<Box<dyn Future<Output = Result<Response<Body>, S::Error>> + Send>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), S::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, mut request: Request<Body>) -> Self::Future {
        let extensions = request.extensions();
        let admission = extensions.get::<Admission>().cloned().or_else(|| {
            let tls = extensions.get::<TlsConnectInfo<Admission>>()?;
            Some(tls.get_ref().clone())
        });
        if let Err(status) = self.rules.check(&request, admission.as_ref()) {
            let peer = admission.and_then(|admission| admission.remote);
            let method = request.uri().path();
            tracing::warn!(?peer, method, reason = status.message(), "refused a call");
            return Box::pin(std::future::ready(Ok(status.into_http())));
        }
        if let Some(admission) = admission {
            // Where services look for the peer's address.
            request.extensions_mut().insert(admission.tcp());
        }
        Box::pin(self.inner.call(request))
    }
}

impl Rules {
    fn check(&self, request: &Request<Body>, from: Option<&Admission>) -> Result<(), Status> {
        let path = request.uri().path();
        if path.starts_with(HEALTH) {
            return Ok(());
        }
        let grant = match &self.tokens {
            Some(tokens) => Some(allowed(tokens, request, path)?),
            None => None,
        };
        match from {
            Some(admission) => admission.ticket.take(self, grant),
            None => Ok(()),
        }
    }
}

/// What the request's token stands for, if it allows this call.
fn allowed(tokens: &Tokens, request: &Request<Body>, path: &str) -> Result<Grant, Status> {
    let header = request.headers().get(http::header::AUTHORIZATION);
    let token = header
        .and_then(|value| value.to_str().ok())
        .and_then(|value| value.strip_prefix("Bearer "))
        .ok_or_else(|| {
            Status::unauthenticated(
                "this server asks for a token and none came; give the file that holds one (--token-file)",
            )
        })?;
    let grant = tokens.find(token).ok_or_else(|| {
        Status::unauthenticated(
            "this server does not know the token; compare --token-file with the server's --tokens",
        )
    })?;
    if !grant.role.may_call(path) {
        let method = path.rsplit('/').next().unwrap_or_default();
        return Err(Status::permission_denied(format!(
            "the token's role is {}, which may not call {method}; use a token of the right role",
            grant.role
        )));
    }
    Ok(grant)
}

/// A connection's place among those of its token, taken with its first call.
#[derive(Debug, Default)]
pub(super) struct Ticket(OnceLock<Place>);

#[derive(Debug)]
struct Place {
    open: Arc<Mutex<HashMap<Option<Grant>, usize>>>,
    grant: Option<Grant>,
}

impl Ticket {
    /// Whether a call was let in.
    pub(super) fn is_taken(&self) -> bool {
        self.0.get().is_some()
    }

    fn take(&self, rules: &Rules, grant: Option<Grant>) -> Result<(), Status> {
        if let Some(place) = self.0.get() {
            if place.grant == grant {
                return Ok(());
            }
            return Err(Status::permission_denied(
                "another token came before on this connection; use one connection for each",
            ));
        }
        {
            let mut open = rules.open.lock().unwrap_or_else(PoisonError::into_inner);
            let count = open.entry(grant).or_default();
            if *count >= rules.max_connections {
                let whose = grant.map_or_else(
                    || "without a token".to_owned(),
                    |grant| format!("with the {} token of line {}", grant.role, grant.line),
                );
                return Err(Status::resource_exhausted(format!(
                    "{count} connections {whose} are open, which is the limit; close some, or raise --max-connections"
                )));
            }
            *count += 1;
        }
        let place = Place {
            open: rules.open.clone(),
            grant,
        };
        // Of two first calls at once one gives its place back here.
        let _ = self.0.set(place);
        Ok(())
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(count) = open.get_mut(&self.grant) {
            *count = count.saturating_sub(1);
        }
    }
}
