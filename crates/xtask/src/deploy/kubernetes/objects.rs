//! Rendered objects, by what the checks ask of them. All accessors answer with nothing where a field is missing:
//! schemas have been seen to by then.

use serde_json::Value;

/// Everything that one overlay makes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Objects<'a>(pub(super) &'a [Value]);

impl<'a> Objects<'a> {
    pub(super) fn of_kind(self, kind: &'static str) -> impl Iterator<Item = &'a Value> {
        self.0.iter().filter(move |object| object["kind"] == kind)
    }

    pub(super) fn find(self, kind: &'static str, wanted: &str) -> Option<&'a Value> {
        self.of_kind(kind).find(|object| name(object) == wanted)
    }

    /// What starts pods.
    pub(super) fn workloads(self) -> impl Iterator<Item = Workload<'a>> {
        let kinds = ["StatefulSet", "Job", "Deployment"];
        self.0
            .iter()
            .filter(move |object| kinds.iter().any(|kind| object["kind"] == *kind))
            .map(Workload)
    }

    /// The workloads whose pods `selector` means.
    pub(super) fn selected(self, selector: &'a Value) -> impl Iterator<Item = Workload<'a>> {
        self.workloads()
            .filter(move |workload| selects(selector, workload.labels()))
    }
}

/// A StatefulSet, Job or Deployment. Its pods have one container.
#[derive(Debug, Clone, Copy)]
pub(super) struct Workload<'a>(pub(super) &'a Value);

impl<'a> Workload<'a> {
    pub(super) fn name(self) -> &'a str {
        name(self.0)
    }

    pub(super) fn labels(self) -> &'a Value {
        &self.0["spec"]["template"]["metadata"]["labels"]
    }

    pub(super) fn pod(self) -> &'a Value {
        &self.0["spec"]["template"]["spec"]
    }

    pub(super) fn container(self) -> &'a Value {
        &self.pod()["containers"][0]
    }

    /// Numbers and names of the ports that the container listens at.
    pub(super) fn ports(self) -> impl Iterator<Item = (u64, &'a str)> {
        list(&self.container()["ports"])
            .iter()
            .filter_map(|port| Some((port["containerPort"].as_u64()?, text(&port["name"]))))
    }

    /// The port of this number or name.
    pub(super) fn port(self, wanted: &Value) -> Option<u64> {
        self.ports()
            .find(|(number, name)| wanted == *number || wanted == *name)
            .map(|(number, _)| number)
    }

    /// The container's arguments with `$(VARIABLE)` replaced by what the environment has, as the kubelet does it.
    pub(super) fn args(self, objects: Objects<'_>) -> Vec<String> {
        let mut args: Vec<String> = list(&self.container()["args"])
            .iter()
            .map(|arg| text(arg).to_owned())
            .collect();
        for variable in list(&self.container()["env"]) {
            let value = env_value(variable, objects);
            let reference = format!("$({})", text(&variable["name"]));
            for arg in &mut args {
                *arg = arg.replace(&reference, value);
            }
        }
        args
    }

    /// The value of `--FLAG=VALUE`.
    pub(super) fn flag(self, flag: &str, objects: Objects<'_>) -> Option<String> {
        self.args(objects)
            .iter()
            .find_map(|arg| Some(arg.strip_prefix(flag)?.strip_prefix('=')?.to_owned()))
    }
}

/// What a variable of a container is, be it in place or in a ConfigMap.
pub(super) fn env_value<'a>(variable: &'a Value, objects: Objects<'a>) -> &'a str {
    let reference = &variable["valueFrom"]["configMapKeyRef"];
    match objects.find("ConfigMap", text(&reference["name"])) {
        Some(map) => text(&map["data"][text(&reference["key"])]),
        None => text(&variable["value"]),
    }
}

/// Whether a label selector means what has `labels`. An empty one means everything.
pub(super) fn selects(selector: &Value, labels: &Value) -> bool {
    let equal = selector["matchLabels"]
        .as_object()
        .into_iter()
        .flatten()
        .all(|(key, value)| labels.get(key) == Some(value));
    equal
        && list(&selector["matchExpressions"])
            .iter()
            .all(|expression| {
                let label = labels.get(text(&expression["key"]));
                let listed = label.is_some_and(|label| list(&expression["values"]).contains(label));
                match text(&expression["operator"]) {
                    "In" => listed,
                    "NotIn" => !listed,
                    "Exists" => label.is_some(),
                    _ => label.is_none(),
                }
            })
}

pub(super) fn name(object: &Value) -> &str {
    text(&object["metadata"]["name"])
}

/// `Kind name`, for messages.
pub(super) fn title(object: &Value) -> String {
    format!("{} {}", text(&object["kind"]), name(object))
}

pub(super) fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

pub(super) fn text(value: &Value) -> &str {
    value.as_str().unwrap_or_default()
}
