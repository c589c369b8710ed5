//! Where roles listen, whom they are told to connect to, and which files they are told to read.

use std::collections::BTreeSet;

use serde_json::Value;

use super::objects::{Objects, Workload, env_value, list, name, text, title};

/// A connection that a role is told to make.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Flow<'a> {
    pub(super) from: &'a str,
    pub(super) to: &'a str,
    pub(super) port: u64,
}

/// The connections of all roles; addresses that nobody has go to `problems`.
pub(super) fn flows<'a>(objects: Objects<'a>, problems: &mut Vec<String>) -> Vec<Flow<'a>> {
    let mut flows = Vec::new();
    for workload in objects.workloads() {
        let replay = workload.flag("--replay", objects).unwrap_or_default();
        let servers: BTreeSet<&str> = replay.split(',').filter(|one| !one.is_empty()).collect();
        let learner = workload.flag("--learner", objects);
        let mut replicas = None;
        for address in servers.iter().copied().chain(learner.as_deref()) {
            match resolve(address, objects) {
                Ok((to, port)) => {
                    replicas = to.0["spec"]["replicas"].as_u64().or(replicas);
                    flows.push(Flow {
                        from: workload.name(),
                        to: to.name(),
                        port,
                    });
                }
                Err(reason) => {
                    problems.push(format!("{}: {address}: {reason}", title(workload.0)));
                }
            }
        }
        if let Some(replicas) = replicas.filter(|replicas| *replicas != servers.len() as u64) {
            problems.push(format!(
                "{}: knows {} replay-servers of {replicas}",
                title(workload.0),
                servers.len()
            ));
        }
    }
    flows
}

/// Which pods `host:port` means, and their port.
fn resolve<'a>(address: &str, objects: Objects<'a>) -> Result<(Workload<'a>, u64), String> {
    let (host, port) = address.split_once(':').ok_or("has no port")?;
    let (pod, service) = match host.split_once('.') {
        Some((pod, service)) => (Some(pod), service),
        None => (None, host),
    };
    let found = objects
        .find("Service", service)
        .ok_or_else(|| format!("there is no Service {service}"))?;
    let headless = found["spec"]["clusterIP"] == "None";
    let port = list(&found["spec"]["ports"])
        .iter()
        .find(|served| served["port"].as_u64() == port.parse().ok())
        .ok_or_else(|| format!("Service {service} has no port {port}"))?;
    let workload = objects
        .workloads()
        .find(|workload| {
            let labels = workload.labels();
            let selector = found["spec"]["selector"].as_object();
            selector.is_some_and(|all| {
                all.iter()
                    .all(|(key, value)| labels.get(key) == Some(value))
            })
        })
        .ok_or_else(|| format!("Service {service} serves no pods"))?;
    match pod {
        None if headless => return Err("names all servers, say which: NAME-0.SERVICE".to_owned()),
        Some(_) if !headless => return Err(format!("Service {service} is not headless")),
        Some(pod) if !is_pod_of(pod, workload) => return Err(format!("there is no pod {pod}")),
        _ => {}
    }
    let target = workload
        .port(&port["targetPort"])
        .ok_or_else(|| format!("nobody listens at {}", port["targetPort"]))?;
    Ok((workload, target))
}

fn is_pod_of(pod: &str, workload: Workload<'_>) -> bool {
    let ordinal = pod
        .strip_prefix(workload.name())
        .and_then(|rest| rest.strip_prefix('-')?.parse::<u64>().ok());
    let replicas = workload.0["spec"]["replicas"].as_u64().unwrap_or(1);
    ordinal.is_some_and(|ordinal| ordinal < replicas)
}

/// Ports that roles listen at and do not declare, or declare and do not listen at.
pub(super) fn listening(objects: Objects<'_>) -> Vec<String> {
    let mut found = Vec::new();
    for workload in objects.workloads() {
        let mut listens: Vec<String> = ["--listen", "--metrics-listen"]
            .iter()
            .filter_map(|flag| workload.flag(flag, objects))
            .collect();
        let mut declared: Vec<String> = workload
            .ports()
            .map(|(number, _)| format!("0.0.0.0:{number}"))
            .collect();
        listens.sort();
        declared.sort();
        if listens != declared {
            found.push(format!(
                "{}: listens at {listens:?} and declares {declared:?}",
                title(workload.0)
            ));
        }
    }
    found
}

/// Files and folders in arguments and environment that no volume has. The file system of the image is read-only and
/// holds nothing that these could mean.
pub(super) fn files(objects: Objects<'_>) -> Vec<String> {
    let mut found = Vec::new();
    for workload in objects.workloads() {
        let env = list(&workload.container()["env"])
            .iter()
            .map(|variable| env_value(variable, objects).to_owned());
        let flags = workload
            .args(objects)
            .into_iter()
            .filter_map(|arg| Some(arg.split_once('=')?.1.to_owned()));
        for path in env.chain(flags).filter(|value| value.starts_with('/')) {
            if !is_mounted(&path, workload, objects) {
                found.push(format!("{}: no volume has {path}", title(workload.0)));
            }
        }
    }
    found
}

fn is_mounted(path: &str, workload: Workload<'_>, objects: Objects<'_>) -> bool {
    let mount = list(&workload.container()["volumeMounts"])
        .iter()
        .find_map(|mount| {
            let file = path
                .strip_prefix(text(&mount["mountPath"]))?
                .strip_prefix('/')?;
            Some((text(&mount["name"]), file))
        });
    let Some((volume_name, file)) = mount else {
        return false;
    };
    let volume = list(&workload.pod()["volumes"])
        .iter()
        .find(|volume| volume["name"] == volume_name);
    // What a volume claim holds is made at run time.
    let Some(volume) = volume.filter(|volume| volume["persistentVolumeClaim"].is_null()) else {
        return true;
    };
    let sources = list(&volume["projected"]["sources"]).iter().chain([volume]);
    sources.into_iter().any(|source| {
        [("ConfigMap", "configMap"), ("Secret", "secret")]
            .iter()
            .any(|(kind, field)| holds(&source[field], kind, file, objects))
    })
}

/// Whether a source of a volume makes `file`.
fn holds(source: &Value, kind: &'static str, file: &str, objects: Objects<'_>) -> bool {
    match source.get("items") {
        Some(items) => list(items).iter().any(|item| item["path"] == file),
        None => objects
            .of_kind(kind)
            .any(|object| name(object) == text(&source["name"]) && !object["data"][file].is_null()),
    }
}
