//! Where roles listen, and whom they are told to connect to.

use std::collections::BTreeSet;

use super::objects::{Objects, Workload, list, title};

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
