//! What every pod promises: the profile `restricted` of the Pod Security Standards and a little more, limits, and time
//! to drain. No cluster is there to refuse a pod that does not.

use serde_json::{Value, json};

use super::objects::{Objects, list, text, title};

/// How long a role may drain, with room to spare.
const GRACE_SECONDS: u64 = 30;

/// Pods that promise less.
pub(super) fn problems(objects: Objects<'_>) -> Vec<String> {
    let mut found = Vec::new();
    for workload in objects.workloads() {
        let pod = workload.pod();
        for (pointer, wanted) in [
            ("/automountServiceAccountToken", json!(false)),
            ("/terminationGracePeriodSeconds", json!(GRACE_SECONDS)),
            ("/securityContext/runAsNonRoot", json!(true)),
            (
                "/securityContext/seccompProfile/type",
                json!("RuntimeDefault"),
            ),
            (
                "/containers/0/securityContext/allowPrivilegeEscalation",
                json!(false),
            ),
            (
                "/containers/0/securityContext/readOnlyRootFilesystem",
                json!(true),
            ),
            (
                "/containers/0/securityContext/capabilities",
                json!({"drop": ["ALL"]}),
            ),
        ] {
            if pod.pointer(pointer) != Some(&wanted) {
                found.push(format!("{}: {pointer} must be {wanted}", title(workload.0)));
            }
        }
        if list(&pod["containers"]).len() != 1 || !pod["initContainers"].is_null() {
            found.push(format!(
                "{}: has not exactly one container",
                title(workload.0)
            ));
        }
        let resources = &workload.container()["resources"];
        for kind in ["requests", "limits"] {
            for resource in ["cpu", "memory"] {
                if resources[kind][resource].is_null() {
                    found.push(format!(
                        "{}: no {resource} among its {kind}",
                        title(workload.0)
                    ));
                }
            }
        }
        found.extend(
            unprobed(workload.container()).map(|probe| format!("{}: {probe}", title(workload.0))),
        );
    }
    for object in objects.0 {
        let namespaced = !["Namespace", "PriorityClass"].contains(&text(&object["kind"]));
        if namespaced && object["metadata"]["namespace"] != "isodream" {
            found.push(format!(
                "{}: is not in the namespace isodream",
                title(object)
            ));
        }
    }
    for account in objects.of_kind("ServiceAccount") {
        if account["automountServiceAccountToken"] != false {
            found.push(format!("{}: hands out its token", title(account)));
        }
    }
    for namespace in objects.of_kind("Namespace") {
        let labels = &namespace["metadata"]["labels"];
        if labels["pod-security.kubernetes.io/enforce"] != "restricted" {
            found.push(format!(
                "{}: does not enforce `restricted`",
                title(namespace)
            ));
        }
    }
    found
}

/// What is wrong with the probes of a container. One without ports has nothing that could be asked.
fn unprobed(container: &Value) -> impl Iterator<Item = String> {
    let serves = !list(&container["ports"]).is_empty();
    let address = list(&container["ports"])
        .iter()
        .find(|port| port["name"] == "grpc")
        .map(|port| format!("localhost:{}", port["containerPort"]))
        .unwrap_or_default();
    ["startupProbe", "readinessProbe", "livenessProbe"]
        .into_iter()
        .filter(move |probe| {
            let command = &container[probe]["exec"]["command"];
            serves && *command != json!(["isodream", "health", address])
        })
        .map(|probe| format!("{probe} must ask `isodream health` at the container's port"))
}
