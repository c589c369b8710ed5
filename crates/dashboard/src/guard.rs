//! Who may look.
//!
//! The page has no accounts. On loopback everybody who can reach it may look, but only under a name of this machine:
//! a page elsewhere whose name resolves to 127.0.0.1 (DNS rebinding) carries its own name. Where other machines can
//! reach it, a token is asked for, once by `?token=` or as a bearer, and then kept in a cookie.

use std::net::SocketAddr;
use std::path::Path;

use axum::extract::{Request, State};
use axum::http::header::{AUTHORIZATION, COOKIE, HOST, LOCATION, SET_COOKIE};
use axum::http::{HeaderMap, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use sha2::{Digest, Sha256};

const COOKIE_NAME: &str = "isodream_token";

/// Who may look.
#[derive(Debug, Clone)]
pub enum Guard {
    /// Everybody who calls it by a name of this machine.
    Loopback,
    /// Who knows the token, of which only the SHA-256 is kept.
    Token([u8; 32]),
    /// Everybody.
    Open,
}

/// Why nobody can be let in.
#[derive(Debug, thiserror::Error)]
pub enum GuardError {
    /// Other machines can reach it, and nothing guards it.
    #[error(
        "{address} can be reached by other machines and nothing guards the dashboard; give --token-file, listen on 127.0.0.1, or pass --insecure"
    )]
    Unguarded {
        /// Where it was to listen.
        address: SocketAddr,
    },
    /// The token cannot be read.
    #[error(
        "cannot read the dashboard's token from {path}: {reason}; write a line of at least 16 characters into it"
    )]
    Token {
        /// The file.
        path: String,
        /// What is wrong with it.
        reason: String,
    },
}

impl Guard {
    /// The guard of a dashboard at `address`.
    ///
    /// # Errors
    /// [`GuardError`].
    pub fn new(
        address: SocketAddr,
        token_file: Option<&Path>,
        insecure: bool,
    ) -> Result<Self, GuardError> {
        match token_file {
            Some(path) => Self::token(path),
            None if address.ip().is_loopback() => Ok(Self::Loopback),
            None if insecure => Ok(Self::Open),
            None => Err(GuardError::Unguarded { address }),
        }
    }

    fn token(path: &Path) -> Result<Self, GuardError> {
        let failed = |reason: String| GuardError::Token {
            path: path.display().to_string(),
            reason,
        };
        let text = std::fs::read_to_string(path).map_err(|error| failed(error.to_string()))?;
        let token = text.trim();
        if token.len() < 16 {
            return Err(failed(format!("it has {} characters", token.len())));
        }
        // It stands in an address and in a cookie as it is.
        let stays = |c: char| c.is_ascii_alphanumeric() || "-._~+/=".contains(c);
        if let Some(odd) = token.chars().find(|&c| !stays(c)) {
            return Err(failed(format!(
                "it has a {odd:?}, where letters, digits and -._~+/= may be"
            )));
        }
        Ok(Self::Token(digest(token)))
    }

    fn knows(&self, token: &str) -> bool {
        matches!(self, Self::Token(known) if *known == digest(token))
    }
}

/// Digests are compared instead of tokens, so that the time it takes tells nothing.
fn digest(token: &str) -> [u8; 32] {
    Sha256::digest(token).into()
}

/// Lets a request through, or answers it.
pub(crate) async fn check(State(guard): State<Guard>, request: Request, next: Next) -> Response {
    let refused = |status, words: &'static str| (status, words).into_response();
    match &guard {
        Guard::Open => {}
        Guard::Loopback if is_local(request.headers()) => {}
        Guard::Loopback => {
            return refused(
                StatusCode::FORBIDDEN,
                "this dashboard answers to localhost only; open it by the address that was printed",
            );
        }
        Guard::Token(_) => {
            let offered = query_token(request.uri().query());
            if let Some(token) = offered.filter(|token| guard.knows(token)) {
                return welcome(
                    &cookie_name(request.headers()),
                    &token,
                    request.uri().path(),
                );
            }
            let carried = [cookie(request.headers()), bearer(request.headers())];
            if !carried.iter().flatten().any(|token| guard.knows(token)) {
                return refused(
                    StatusCode::UNAUTHORIZED,
                    "open this dashboard once with ?token=TOKEN, the line in its token file",
                );
            }
        }
    }
    next.run(request).await
}

/// Keeps the token in a cookie and takes it out of the address.
fn welcome(name: &str, token: &str, path: &str) -> Response {
    let cookie = format!("{name}={token}; Path=/; HttpOnly; SameSite=Strict");
    let headers = [(SET_COOKIE, cookie), (LOCATION, path.to_owned())];
    (StatusCode::SEE_OTHER, headers).into_response()
}

/// Cookies know no ports, and several pages of a machine may have tokens of their own: the name says which it is.
fn cookie_name(headers: &HeaderMap) -> String {
    match host(headers) {
        Some((_, Some(port))) => format!("{COOKIE_NAME}_{port}"),
        _ => COOKIE_NAME.to_owned(),
    }
}

/// The name by which the page is called, and the port if there is one.
fn host(headers: &HeaderMap) -> Option<(&str, Option<&str>)> {
    let host = headers.get(HOST)?.to_str().ok()?;
    Some(match host.rsplit_once(':') {
        Some((name, port)) if port.chars().all(|c| c.is_ascii_digit()) => (name, Some(port)),
        _ => (host, None),
    })
}

fn is_local(headers: &HeaderMap) -> bool {
    let Some((name, _)) = host(headers) else {
        return false;
    };
    let bare = name.trim_start_matches('[').trim_end_matches(']');
    name == "localhost"
        || bare
            .parse::<std::net::IpAddr>()
            .is_ok_and(|ip| ip.is_loopback())
}

/// Tokens are of characters that need no escapes.
fn query_token(query: Option<&str>) -> Option<String> {
    let pairs = query?.split('&');
    let mut tokens = pairs.filter_map(|pair| pair.strip_prefix("token="));
    tokens.next().map(str::to_owned)
}

fn cookie(headers: &HeaderMap) -> Option<&str> {
    let pairs = headers.get(COOKIE)?.to_str().ok()?.split(';');
    let mut values = pairs.filter_map(|pair| pair.trim().split_once('='));
    let ours = cookie_name(headers);
    values.find_map(|(name, value)| (name == ours).then_some(value))
}

fn bearer(headers: &HeaderMap) -> Option<&str> {
    headers
        .get(AUTHORIZATION)?
        .to_str()
        .ok()?
        .strip_prefix("Bearer ")
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn only_names_of_this_machine_are_local() {
        let local = |host: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(HOST, host.parse().unwrap());
            is_local(&headers)
        };
        for host in [
            "localhost",
            "localhost:7000",
            "127.0.0.1:7000",
            "[::1]:7000",
        ] {
            assert!(local(host), "{host}");
        }
        for host in [
            "evil.example",
            "127.0.0.1.evil.example:7000",
            "10.0.0.7:7000",
            "::1evil",
        ] {
            assert!(!local(host), "{host}");
        }
        assert!(!is_local(&HeaderMap::new()));
    }

    #[test]
    fn an_address_that_others_reach_needs_a_token() {
        let everywhere = "0.0.0.0:7000".parse().unwrap();
        let error = Guard::new(everywhere, None, false).unwrap_err();
        assert!(error.to_string().contains("--token-file"), "{error}");
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("token");
        std::fs::write(&path, "short\n").unwrap();
        let error = Guard::new(everywhere, Some(&path), false).unwrap_err();
        assert!(error.to_string().contains("5 characters"), "{error}");
        std::fs::write(&path, "0123456789&abcdef\n").unwrap();
        let error = Guard::new(everywhere, Some(&path), false).unwrap_err();
        assert!(error.to_string().contains("it has a '&'"), "{error}");
        std::fs::write(&path, "0123456789abcdef\n").unwrap();
        let guard = Guard::new(everywhere, Some(&path), false).unwrap();
        assert!(guard.knows("0123456789abcdef") && !guard.knows("0123456789abcdeF"));
    }
}
