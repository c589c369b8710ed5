//! `isodream secrets`: certificates and tokens for a run over several machines.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use isodream_rpc::Role;
use rand::distr::{Alphanumeric, SampleString};
use rand::rand_core::UnwrapErr;
use rand::rngs::SysRng;
use rcgen::{
    BasicConstraints, CertificateParams, CertifiedIssuer, DistinguishedName, DnType,
    ExtendedKeyUsagePurpose, IsCa, KeyPair, KeyUsagePurpose,
};
use time::{Duration, OffsetDateTime};

use crate::output::print;

/// Characters of a token: 256 bits and more.
const TOKEN_LENGTH: usize = 43;

const SERVER: ExtendedKeyUsagePurpose = ExtendedKeyUsagePurpose::ServerAuth;
const CLIENT: ExtendedKeyUsagePurpose = ExtendedKeyUsagePurpose::ClientAuth;

/// Options of `isodream secrets`.
#[derive(Debug, Args)]
pub(crate) struct SecretsArgs {
    /// Where they go
    dir: PathBuf,
    /// A name or address that clients reach servers by; may be repeated. This machine's own loopback names are
    /// always among them
    #[arg(long = "host", value_name = "NAME")]
    hosts: Vec<String>,
    /// Days that the certificates are valid
    #[arg(long, default_value_t = 365, value_parser = clap::value_parser!(u16).range(1..))]
    days: u16,
}

/// Makes a certificate authority, certificates for servers and clients, and a token for each role.
pub(crate) fn run(args: &SecretsArgs) -> anyhow::Result<()> {
    let dir = &args.dir;
    fs::DirBuilder::new()
        .recursive(true)
        .mode(0o700)
        .create(dir)
        .with_context(|| format!("cannot create {}", dir.display()))?;
    if dir.join("ca.pem").exists() {
        bail!(
            "{} holds secrets already, which running processes may use; choose another folder, or remove it first",
            dir.display()
        );
    }
    let authority = authority(args.days)?;
    let mut hosts: Vec<String> = ["localhost", "127.0.0.1", "::1"].map(str::to_owned).into();
    hosts.extend(args.hosts.iter().cloned());
    for (name, names, purposes) in [
        // A learner may show the same certificate to its actors and to the replay-servers.
        ("server", hosts, vec![SERVER, CLIENT]),
        ("client", Vec::new(), vec![CLIENT]),
    ] {
        let key = KeyPair::generate()?;
        let certificate = leaf(name, names, purposes, args.days)?
            .signed_by(&key, &authority)
            .with_context(|| format!("cannot make the certificate of the {name}"))?;
        write(dir, &format!("{name}.pem"), &certificate.pem())?;
        write(dir, &format!("{name}.key"), &key.serialize_pem())?;
    }
    let mut tokens = String::from("# ROLE TOKEN\n");
    for role in Role::ALL {
        let token = random(TOKEN_LENGTH);
        tokens += &format!("{role} {token}\n");
        write(dir, &format!("{role}.token"), &format!("{token}\n"))?;
    }
    write(dir, "tokens", &tokens)?;
    write(dir, "ca.key", &authority.key().serialize_pem())?;
    // Last: its presence says that all others are there.
    write(dir, "ca.pem", &authority.pem())?;
    print(&format!(
        "{}: certificates for {} days and tokens; give every role --secrets {0}, and each machine only the files that its roles need",
        dir.display(),
        args.days
    ))
}

fn authority(days: u16) -> anyhow::Result<CertifiedIssuer<'static, KeyPair>> {
    // Certificates name their authority, and are to be told from those of another folder.
    let name = format!("isodream authority {}", random(8));
    let mut params = params(&name, Vec::new(), days)?;
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    Ok(CertifiedIssuer::self_signed(params, KeyPair::generate()?)?)
}

fn leaf(
    name: &str,
    hosts: Vec<String>,
    purposes: Vec<ExtendedKeyUsagePurpose>,
    days: u16,
) -> anyhow::Result<CertificateParams> {
    let mut params = params(&format!("isodream {name}"), hosts, days)?;
    params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    params.extended_key_usages = purposes;
    params.use_authority_key_identifier_extension = true;
    Ok(params)
}

fn params(name: &str, hosts: Vec<String>, days: u16) -> anyhow::Result<CertificateParams> {
    let mut params = CertificateParams::new(hosts).context("a --host is no name and no address")?;
    params.distinguished_name = DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, name);
    let now = OffsetDateTime::now_utc();
    // Clocks of other machines may be behind.
    params.not_before = now - Duration::days(1);
    params.not_after = now + Duration::days(i64::from(days));
    Ok(params)
}

/// A file that its owner alone can read.
fn write(dir: &Path, name: &str, text: &str) -> anyhow::Result<()> {
    let path = dir.join(name);
    OpenOptions::new()
        .write(true)
        .create(true)
        .truncate(true)
        .mode(0o600)
        .open(&path)
        .and_then(|mut file| file.write_all(text.as_bytes()))
        .with_context(|| format!("cannot write {}", path.display()))
}

/// Letters and digits from the system's source of randomness.
fn random(length: usize) -> String {
    Alphanumeric.sample_string(&mut UnwrapErr(SysRng), length)
}
