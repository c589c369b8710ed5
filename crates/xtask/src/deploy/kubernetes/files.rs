//! Files that roles are told to read must be in their volumes, and each role must have its own secrets and no other.

use std::collections::BTreeSet;

use serde_json::Value;

use super::objects::{Objects, Workload, env_value, list, text, title};

/// Where a role finds its secrets.
const SECRETS_VARIABLE: &str = "ISODREAM_SECRETS";
/// What every role shows and trusts: the roles that serve are clients of their own for the probes.
const OF_CLIENTS: [&str; 3] = ["ca.pem", "client.key", "client.pem"];
/// What a role that serves has on top of that.
const OF_SERVERS: [&str; 3] = ["server.key", "server.pem", "tokens"];

/// Paths that no volume has, and secrets that are missing or belong to another role.
pub(super) fn problems(objects: Objects<'_>) -> Vec<String> {
    let mut found = Vec::new();
    for workload in objects.workloads() {
        let variables = list(&workload.container()["env"]);
        let values = variables
            .iter()
            .map(|variable| env_value(variable, objects));
        let args = workload.args(objects);
        let args = args.iter().filter_map(|arg| Some(arg.split_once('=')?.1));
        // The file system of the image is read-only, and holds nothing that these could mean.
        let paths = values.chain(args).filter(|value| value.starts_with('/'));
        let missing = paths.filter(|path| !is_mounted(path, workload, objects));
        found.extend(missing.map(|path| format!("{}: no volume has {path}", title(workload.0))));

        let folder = variables
            .iter()
            .find(|variable| variable["name"] == SECRETS_VARIABLE)
            .and_then(|variable| mounted(text(&variable["value"]), workload));
        let has: BTreeSet<&str> = folder
            .and_then(|(volume, _)| contents(volume, objects)?.as_object())
            .into_iter()
            .flatten()
            .map(|(file, _)| file.as_str())
            .collect();
        let wants = own_secrets(workload);
        if has != wants {
            found.push(format!(
                "{}: has the secrets {has:?}, not {wants:?}",
                title(workload.0)
            ));
        }
    }
    found
}

fn own_secrets(workload: Workload<'_>) -> BTreeSet<&'static str> {
    let mut own: BTreeSet<&str> = OF_CLIENTS.into();
    if workload.ports().next().is_some() {
        own.extend(OF_SERVERS);
    }
    own.extend(match text(&workload.container()["args"][0]) {
        "actor" => Some("actor.token"),
        "learner" => Some("learner.token"),
        _ => None,
    });
    own
}

fn is_mounted(path: &str, workload: Workload<'_>, objects: Objects<'_>) -> bool {
    let Some((volume, file)) = mounted(path, workload) else {
        return false;
    };
    // What a claim holds is made by those who use it.
    file.is_empty() || contents(volume, objects).is_none_or(|files| !files[file].is_null())
}

/// The volume that `path` is in, and where in it.
fn mounted<'a, 'p>(path: &'p str, workload: Workload<'a>) -> Option<(&'a Value, &'p str)> {
    let (volume_name, file) = list(&workload.container()["volumeMounts"])
        .iter()
        .find_map(|mount| {
            let rest = path.strip_prefix(text(&mount["mountPath"]))?;
            let file = if rest.is_empty() {
                rest
            } else {
                rest.strip_prefix('/')?
            };
            Some((&mount["name"], file))
        })?;
    let pod = list(&workload.pod()["volumes"]);
    let claims = list(&workload.0["spec"]["volumeClaimTemplates"]);
    let volume = pod.iter().find(|volume| volume["name"] == *volume_name);
    let claim = claims
        .iter()
        .find(|claim| claim["metadata"]["name"] == *volume_name);
    Some((volume.or(claim)?, file))
}

/// The files of a volume that is a ConfigMap or a Secret.
fn contents<'a>(volume: &Value, objects: Objects<'a>) -> Option<&'a Value> {
    let map = objects.find("ConfigMap", text(&volume["configMap"]["name"]));
    let secret = objects.find("Secret", text(&volume["secret"]["secretName"]));
    Some(&map.or(secret)?["data"])
}
