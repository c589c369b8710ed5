//! What objects name must exist.

use serde_json::json;

use super::objects::{Objects, Workload, list, name, selects, text, title};

/// Names of objects, keys, volumes and ports that nothing has.
pub(super) fn problems(objects: Objects<'_>) -> Vec<String> {
    let mut found = Vec::new();
    for workload in objects.workloads() {
        let mut missing: Vec<String> = named(workload)
            .filter(|(kind, name)| !name.is_empty() && objects.find(kind, name).is_none())
            .map(|(kind, name)| format!("{kind} {name}"))
            .collect();
        missing.extend(missing_keys(workload, objects));
        missing.extend(missing_volumes(workload));
        let title = title(workload.0);
        found.extend(
            missing
                .iter()
                .map(|what| format!("{title}: there is no {what}")),
        );
        // A Job is given its selector by the cluster.
        if workload.0["kind"] != "Job"
            && !selects(&workload.0["spec"]["selector"], workload.labels())
        {
            found.push(format!("{title}: selects other pods than its own"));
        }
    }
    for service in objects.of_kind("Service") {
        let selector = json!({"matchLabels": service["spec"]["selector"]});
        let serving: Vec<Workload<'_>> = objects
            .workloads()
            .filter(|workload| selects(&selector, workload.labels()))
            .collect();
        if serving.len() != 1 {
            found.push(format!(
                "{}: means {} workloads, not one",
                title(service),
                serving.len()
            ));
        }
        for port in list(&service["spec"]["ports"]) {
            for workload in &serving {
                if workload.port(&port["targetPort"]).is_none() {
                    found.push(format!(
                        "{}: there is no port {}",
                        title(service),
                        port["targetPort"]
                    ));
                }
            }
        }
    }
    for (kind, selector) in [
        ("PodDisruptionBudget", "selector"),
        ("NetworkPolicy", "podSelector"),
    ] {
        for object in objects.of_kind(kind) {
            if objects.selected(&object["spec"][selector]).next().is_none() {
                found.push(format!("{}: selects no pods", title(object)));
            }
        }
    }
    for scaler in objects.of_kind("HorizontalPodAutoscaler") {
        let target = text(&scaler["spec"]["scaleTargetRef"]["name"]);
        match objects.find("Deployment", target) {
            None => found.push(format!(
                "{}: there is no Deployment {target}",
                title(scaler)
            )),
            Some(target) if !target["spec"]["replicas"].is_null() => found.push(format!(
                "{}: replicas would be undone by, and undo, {}",
                title(target),
                title(scaler)
            )),
            Some(_) => {}
        }
    }
    found
}

/// Kinds and names of the objects that a workload cannot do without.
fn named<'a>(workload: Workload<'a>) -> impl Iterator<Item = (&'static str, &'a str)> {
    let pod = workload.pod();
    let volumes = list(&pod["volumes"]).iter().flat_map(|volume| {
        [
            (
                "PersistentVolumeClaim",
                text(&volume["persistentVolumeClaim"]["claimName"]),
            ),
            ("ConfigMap", text(&volume["configMap"]["name"])),
            ("Secret", text(&volume["secret"]["secretName"])),
        ]
    });
    let variables = list(&workload.container()["env"]).iter().map(|variable| {
        (
            "ConfigMap",
            text(&variable["valueFrom"]["configMapKeyRef"]["name"]),
        )
    });
    [
        ("ServiceAccount", text(&pod["serviceAccountName"])),
        ("PriorityClass", text(&pod["priorityClassName"])),
        ("Service", text(&workload.0["spec"]["serviceName"])),
    ]
    .into_iter()
    .chain(volumes)
    .chain(variables)
}

/// Keys of ConfigMaps that are nowhere.
fn missing_keys<'a>(
    workload: Workload<'a>,
    objects: Objects<'a>,
) -> impl Iterator<Item = String> + use<'a> {
    list(&workload.container()["env"])
        .iter()
        .filter_map(move |variable| {
            let reference = &variable["valueFrom"]["configMapKeyRef"];
            let map = objects.find("ConfigMap", text(&reference["name"]))?;
            let key = text(&reference["key"]);
            map["data"][key]
                .is_null()
                .then(|| format!("key {key} in {}", title(map)))
        })
}

/// Volumes that are mounted and not declared, and ports that probes ask for by name.
fn missing_volumes(workload: Workload<'_>) -> impl Iterator<Item = String> {
    let claims = list(&workload.0["spec"]["volumeClaimTemplates"])
        .iter()
        .map(name);
    let declared: Vec<&str> = list(&workload.pod()["volumes"])
        .iter()
        .map(|volume| text(&volume["name"]))
        .chain(claims)
        .collect();
    list(&workload.container()["volumeMounts"])
        .iter()
        .map(|mount| text(&mount["name"]))
        .filter(move |mounted| !declared.contains(mounted))
        .map(|mounted| format!("volume {mounted}"))
}
