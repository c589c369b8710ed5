//! Everybody who may not come in, at every door: wrong tokens and roles, missing or wrong encryption, certificates
//! that are expired or of another authority.

mod servers;

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};
use isodream_rpc::{Credentials, Dialer, Files, Role};
use tonic::Code;

use self::servers::Servers;
use super::Context;
use super::calls::{self, Call, STRANGER};
use crate::ledger::Stored;
use crate::secrets;
use crate::table::Row;

/// One kind of intruder.
struct Intruder {
    fault: &'static str,
    how: &'static str,
    client: Files,
    server: Files,
    /// The calls that are to be refused.
    calls: &'static [Call],
    /// What the refusal has to say.
    words: &'static [&'static str],
    /// None where the connection itself is refused.
    code: Option<Code>,
}

/// Folders made by `isodream secrets`.
struct Secrets {
    good: PathBuf,
    /// Of an authority that nobody here trusts.
    foreign: PathBuf,
    /// Made thirty days ago, for a day.
    expired: PathBuf,
}

pub(super) fn run(context: &Context) -> Result<Vec<Row>> {
    let folder = tempfile::tempdir()?;
    let folders = Secrets {
        good: folder.path().join("good"),
        foreign: folder.path().join("foreign"),
        expired: folder.path().join("expired"),
    };
    secrets::make(&context.binary, &folders.good, &[], None)?;
    secrets::make(&context.binary, &folders.foreign, &[], None)?;
    secrets::make(&context.binary, &folders.expired, &[], Some("-30d"))?;
    let unknown = folder.path().join("unknown.token");
    std::fs::write(&unknown, "0123456789abcdefghijklmnopqrstuvwxyz\n")?;
    let mut rows = Vec::new();
    for (number, intruder) in intruders(&folders, &unknown).into_iter().enumerate() {
        let mut row = Row::new(intruder.fault, intruder.how);
        let home = folder.path().join(number.to_string());
        let refused = refused(context, &home, &intruder, &mut row);
        row.take(refused);
        rows.push(row);
    }
    Ok(rows)
}

fn intruders(secrets: &Secrets, unknown: &Path) -> Vec<Intruder> {
    let server = Files::of_server(&secrets.good);
    let actor = Files::of_client(&secrets.good, Role::Actor);
    let without_token = Files {
        token: None,
        ..actor.clone()
    };
    let with_token = |token: &Path| Files {
        token: Some(token.to_owned()),
        ..actor.clone()
    };
    let plain = Files {
        token: actor.token.clone(),
        ..Files::default()
    };
    let foreign = Files::of_client(&secrets.foreign, Role::Actor);
    let expired = Files::of_client(&secrets.expired, Role::Actor);
    let as_role = |role| Files::of_client(&secrets.good, role);
    let token = |fault, how, client, calls, words, code| Intruder {
        fault,
        how,
        client,
        server: server.clone(),
        calls,
        words,
        code: Some(code),
    };
    let tls = |fault, how, client, server: Files, words| Intruder {
        fault,
        how,
        client,
        server,
        calls: &Call::ALL,
        words,
        code: None,
    };
    vec![
        token(
            "no token",
            "mutual TLS, no authorization",
            without_token,
            &Call::ALL,
            &["asks for a token"],
            Code::Unauthenticated,
        ),
        token(
            "a wrong token",
            "mutual TLS, a token that the server does not know",
            with_token(unknown),
            &Call::ALL,
            &["does not know the token"],
            Code::Unauthenticated,
        ),
        token(
            "a wrong role: actor",
            "the actor's token for what it may not call",
            actor.clone(),
            &[Call::Sample],
            &["role is actor"],
            Code::PermissionDenied,
        ),
        token(
            "a wrong role: learner",
            "the learner's token for what it may not call",
            as_role(Role::Learner),
            &[
                Call::Append,
                Call::WatchPolicy,
                Call::FetchPolicy,
                Call::ReportEpisode,
            ],
            &["role is learner"],
            Code::PermissionDenied,
        ),
        token(
            "a wrong role: viewer",
            "the viewer's token for what it may not call",
            as_role(Role::Viewer),
            &[
                Call::Append,
                Call::Sample,
                Call::WatchPolicy,
                Call::FetchPolicy,
                Call::ReportEpisode,
                Call::Environment,
            ],
            &["role is viewer"],
            Code::PermissionDenied,
        ),
        tls(
            "plaintext to TLS",
            "a client without certificates, with the right token",
            plain,
            server.clone(),
            &["frame with invalid size"],
        ),
        tls(
            "TLS to plaintext",
            "a client with certificates at servers without",
            actor.clone(),
            Files::default(),
            &["InvalidContentType"],
        ),
        tls(
            "no certificate at mutual TLS",
            "a client that trusts the servers and shows nothing",
            Files {
                cert: None,
                key: None,
                ..actor.clone()
            },
            server.clone(),
            &["CertificateRequired", "certificate required"],
        ),
        tls(
            "a client's expired certificate",
            "made 30 days ago for a day; the servers trust its authority",
            Files {
                ca: actor.ca.clone(),
                ..expired.clone()
            },
            Files {
                client_ca: expired.ca.clone(),
                ..server.clone()
            },
            &["CertificateExpired", "certificate expired"],
        ),
        tls(
            "a server's expired certificate",
            "the same; the client trusts its authority",
            expired,
            Files::of_server(&secrets.expired),
            &["Expired", "expired"],
        ),
        tls(
            "a client's certificate of another authority",
            "made by another `isodream secrets`",
            Files {
                ca: actor.ca.clone(),
                ..foreign.clone()
            },
            server.clone(),
            &[
                "UnknownCA",
                "UnknownIssuer",
                "DecryptError",
                "received fatal alert",
            ],
        ),
        tls(
            "a server's certificate of another authority",
            "the same",
            foreign,
            server,
            &["UnknownIssuer", "BadSignature"],
        ),
    ]
}

/// Whether a connection ended before its reason came.
fn is_cut(said: &str) -> bool {
    ["broken pipe", "connection closed", "reset by peer"]
        .iter()
        .any(|words| said.contains(words))
}

/// Tries every call at servers of its own, then the right credentials, and then looks into the store.
fn refused(context: &Context, home: &Path, intruder: &Intruder, row: &mut Row) -> Result<()> {
    let servers = Servers::start(&context.binary, home, &intruder.server)?;
    let dialer = Dialer::new(Credentials::load(&intruder.client)?);
    // In TLS 1.3 a server's alert races with what the client sends: not every attempt hears the reason.
    let (mut silent, mut told) = (0, None);
    for &call in intruder.calls {
        row.tried += 1;
        let Err(status) = servers.call(dialer.clone(), call)? else {
            bail!("{call:?} was answered");
        };
        let said = calls::with_causes(&status);
        let is_meant = intruder.words.iter().any(|words| said.contains(words));
        if is_meant && intruder.code.is_none_or(|code| code == status.code()) {
            told.get_or_insert(format!(
                "{call:?} is refused with {:?}: {said}",
                status.code()
            ));
        } else if intruder.code.is_none() && is_cut(&said) {
            silent += 1;
        } else {
            bail!("{call:?} was refused with {:?}: {said}", status.code());
        }
    }
    row.notes.push(told.context("no refusal had a reason")?);
    if silent > 0 {
        row.notes.push(format!(
            "{silent} of {} refusals came without their reason",
            row.tried
        ));
    }
    if intruder.code.is_some() {
        let complaints = servers.log()?.matches("refused a call").count();
        row.notes.push(format!(
            "{complaints} lines `refused a call` in the servers' logs"
        ));
        if complaints != intruder.calls.len() {
            row.failures.push(format!(
                "{complaints} lines tell of {} refused calls",
                intruder.calls.len()
            ));
        }
    }
    servers.check_alive().context("after it")?;
    let store = servers.stop()?;
    let mut stored = Stored::default();
    if store.join("ID").exists() {
        stored.read(&store, |chunk| {
            ensure!(chunk.actor_id != STRANGER, "a refused chunk is stored");
            Ok(())
        })?;
    }
    Ok(())
}
