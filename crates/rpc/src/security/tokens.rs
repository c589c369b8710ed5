//! Bearer tokens and what they allow.

use std::collections::HashMap;
use std::fmt;
use std::path::Path;
use std::str::FromStr;
use std::sync::Arc;

use sha2::{Digest, Sha256};

use super::SecurityError;
use super::files::text;

/// Characters of a token at least.
const MIN_LENGTH: usize = 16;

/// What the bearer of a token may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Role {
    /// Append experience, follow the policy, report episodes, drive environments, read status.
    Actor,
    /// Sample experience, ask for an environment's spec, read status.
    Learner,
    /// Read status.
    Viewer,
}

impl Role {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Actor, Self::Learner, Self::Viewer];

    /// Whether this role may call the method at `path` (`/package.Service/Method`).
    pub(crate) fn may_call(self, path: &str) -> bool {
        match path {
            "/isodream.v1.ReplayService/Append"
            | "/isodream.v1.LearnerService/WatchPolicy"
            | "/isodream.v1.LearnerService/FetchPolicy"
            | "/isodream.v1.LearnerService/ReportEpisode" => self == Self::Actor,
            "/isodream.v1.ReplayService/Sample" => self == Self::Learner,
            "/isodream.v1.EnvironmentService/Run" => self != Self::Viewer,
            "/isodream.v1.ReplayService/Status" | "/isodream.v1.LearnerService/Status" => true,
            // A method that is new needs a decision here first.
            _ => false,
        }
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Actor => "actor",
            Self::Learner => "learner",
            Self::Viewer => "viewer",
        })
    }
}

impl FromStr for Role {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let role = Self::ALL.into_iter().find(|role| role.to_string() == name);
        role.ok_or_else(|| format!("`{name}` is no role; there are actor, learner and viewer"))
    }
}

/// The tokens that a server takes: a file with a line for each, `ROLE TOKEN`. Empty lines and lines that begin
/// with `#` say nothing. Only hashes are kept.
#[derive(Debug, Clone)]
pub struct Tokens(Arc<HashMap<[u8; 32], Grant>>);

/// What one token stands for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Grant {
    pub(crate) role: Role,
    /// Its line in the file, which is how it is named.
    pub(crate) line: usize,
}

impl Tokens {
    /// Reads such a file.
    ///
    /// # Errors
    /// [`SecurityError`] where it cannot be read, a line makes no sense, a token is there twice, or there is none.
    pub fn load(path: &Path) -> Result<Self, SecurityError> {
        Self::parse(&text(path)?).map_err(|reason| SecurityError::Invalid {
            path: path.to_owned(),
            reason,
        })
    }

    fn parse(text: &str) -> Result<Self, String> {
        let mut grants = HashMap::new();
        for (index, line) in text.lines().enumerate() {
            let line_number = index + 1;
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let at = |reason: String| format!("line {line_number}: {reason}");
            let (role, token) = line
                .split_once(char::is_whitespace)
                .ok_or_else(|| at("expected ROLE TOKEN".to_owned()))?;
            let token = token.trim();
            check(token).map_err(at)?;
            let grant = Grant {
                role: role.parse().map_err(at)?,
                line: line_number,
            };
            if let Some(before) = grants.insert(digest(token), grant) {
                return Err(at(format!("the same token as in line {}", before.line)));
            }
        }
        if grants.is_empty() {
            return Err("it holds no token; write lines `ROLE TOKEN`".to_owned());
        }
        Ok(Self(Arc::new(grants)))
    }

    pub(crate) fn find(&self, token: &str) -> Option<Grant> {
        // The look-up compares hashes: its time tells nothing of the tokens.
        self.0.get(&digest(token)).copied()
    }
}

/// Whether `token` can be one, without repeating it.
pub(super) fn check(token: &str) -> Result<(), String> {
    if token.len() < MIN_LENGTH {
        return Err(format!("a token has at least {MIN_LENGTH} characters"));
    }
    if !token.bytes().all(|byte| byte.is_ascii_graphic()) {
        return Err("a token has printable characters and no spaces".to_owned());
    }
    Ok(())
}

fn digest(token: &str) -> [u8; 32] {
    Sha256::digest(token.as_bytes()).into()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn a_file_of_tokens_names_roles() {
        let tokens = Tokens::parse(
            "# made today\n\nactor  aaaaaaaaaaaaaaaa\nlearner bbbbbbbbbbbbbbbb\nviewer\tcccccccccccccccc\n",
        )
        .unwrap();
        let grant = tokens.find("bbbbbbbbbbbbbbbb").unwrap();
        assert_eq!((grant.role, grant.line), (Role::Learner, 4));
        assert_eq!(tokens.find("aaaaaaaaaaaaaaaa").unwrap().role, Role::Actor);
        assert!(tokens.find("aaaaaaaaaaaaaaab").is_none());
        assert!(!format!("{tokens:?}").contains("aaaa"));
    }

    #[test]
    fn senseless_files_are_refused_by_line_and_without_the_token() {
        for (text, words) in [
            ("", "holds no token"),
            ("actor", "line 1: expected ROLE TOKEN"),
            ("\nking aaaaaaaaaaaaaaaa", "line 2: `king` is no role"),
            (
                "actor tooshort",
                "line 1: a token has at least 16 characters",
            ),
            ("actor aaaaaaaa aaaaaaaaa", "line 1: a token has printable"),
            (
                "actor aaaaaaaaaaaaaaaa\nviewer aaaaaaaaaaaaaaaa",
                "line 2: the same token as in line 1",
            ),
        ] {
            let error = Tokens::parse(text).unwrap_err();
            assert!(error.contains(words), "{error}");
            assert!(
                !error.contains("tooshort") && !error.contains("aaaa"),
                "{error}"
            );
        }
    }

    #[test]
    fn roles_may_call_what_they_are_for_and_nothing_else() {
        let calls = |role: Role, service: &str, method: &str| {
            role.may_call(&format!("/isodream.v1.{service}/{method}"))
        };
        for (service, method, allowed) in [
            ("ReplayService", "Append", vec![Role::Actor]),
            ("ReplayService", "Sample", vec![Role::Learner]),
            ("ReplayService", "Status", Role::ALL.to_vec()),
            ("LearnerService", "WatchPolicy", vec![Role::Actor]),
            ("LearnerService", "FetchPolicy", vec![Role::Actor]),
            ("LearnerService", "ReportEpisode", vec![Role::Actor]),
            ("LearnerService", "Status", Role::ALL.to_vec()),
            (
                "EnvironmentService",
                "Run",
                vec![Role::Actor, Role::Learner],
            ),
            ("ReplayService", "Reset", vec![]),
        ] {
            for role in Role::ALL {
                assert_eq!(
                    calls(role, service, method),
                    allowed.contains(&role),
                    "{role} {service}/{method}"
                );
            }
        }
    }
}
