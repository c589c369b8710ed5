//! What objects name must exist.

use serde_json::{Value, json};

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
    let claims = list(&pod["volumes"]).iter().map(|volume| {
        (
            "PersistentVolumeClaim",
            text(&volume["persistentVolumeClaim"]["claimName"]),
        )
    });
    [
        ("ServiceAccount", text(&pod["serviceAccountName"])),
        ("PriorityClass", text(&pod["priorityClassName"])),
        ("Service", text(&workload.0["spec"]["serviceName"])),
    ]
    .into_iter()
    .chain(claims)
}

/// ConfigMaps, Secrets and keys of these that are nowhere.
fn missing_keys(workload: Workload<'_>, objects: Objects<'_>) -> Vec<String> {
    let mut missing = Vec::new();
    let mut want = |kind: &'static str, reference: &Value, name_field: &str, keys: &[&str]| {
        let wanted = text(&reference[name_field]);
        match objects.find(kind, wanted) {
            None => missing.push(format!("{kind} {wanted}")),
            Some(object) => missing.extend(
                keys.iter()
                    .filter(|key| object["data"][**key].is_null())
                    .map(|key| format!("key {key} in {kind} {}", name(object))),
            ),
        }
    };
    let items = |source: &Value| -> Vec<String> {
        list(&source["items"])
            .iter()
            .map(|item| text(&item["key"]).to_owned())
            .collect()
    };
    for variable in list(&workload.container()["env"]) {
        for (kind, field) in [("ConfigMap", "configMapKeyRef"), ("Secret", "secretKeyRef")] {
            if let Some(reference) = variable["valueFrom"].get(field) {
                want(kind, reference, "name", &[text(&reference["key"])]);
            }
        }
    }
    for volume in list(&workload.pod()["volumes"]) {
        let projected = list(&volume["projected"]["sources"])
            .iter()
            .map(|source| (source, "name"));
        for (source, secret_name) in projected.chain([(volume, "secretName")]) {
            for (kind, field, name_field) in [
                ("ConfigMap", "configMap", "name"),
                ("Secret", "secret", secret_name),
            ] {
                if let Some(reference) = source.get(field) {
                    let keys = items(reference);
                    let keys: Vec<&str> = keys.iter().map(String::as_str).collect();
                    want(kind, reference, name_field, &keys);
                }
            }
        }
    }
    missing
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
