//! The checks, shown to fail: the small overlay as it is, and with one thing broken at a time.

#![allow(clippy::unwrap_used)]

use std::os::unix::fs::PermissionsExt;

use super::objects::title;
use super::*;

/// What is broken, where (`@` is the container), the new value (`-` takes the field out), and what is said. A name may
/// be the beginning of one.
const REFUSED_BY_SCHEMAS: &str = r#"
StatefulSet replay    | /spec/replica                             | 2           | 'replica' was unexpected
StatefulSet replay    | /spec/replicas                            | "two"       | is not of type
Job learner           | /spec/podFailurePolicy/rules/2/onPodConditions/0/status | - | 'status' is a required property
Deployment actor      | @/image                                   | 1           | is not of type
Deployment actor      | @/evn                                     | []          | 'evn' was unexpected
Horizontal            | /spec/metrics/0/external/target/vale      | "1"         | 'vale' was unexpected
Horizontal            | /apiVersion                               | "autoscaling/v2beta2" | find schema
"#;
const REFUSED_BY_US: &str = r#"
ConfigMap run         | /metadata/name                            | "other"     | there is no ConfigMap run-
ConfigMap run         | /data/preset                              | -           | there is no key preset
Secret actor          | /metadata/name                            | "other"     | there is no Secret actor-secrets
PersistentVolumeClaim | /metadata/name                            | "other"     | there is no PersistentVolumeClaim learner
ServiceAccount actor  | /metadata/name                            | "other"     | there is no ServiceAccount actor
PriorityClass         | /metadata/name                            | "other"     | there is no PriorityClass isodream-learner
StatefulSet replay    | @/volumeMounts/0/name                     | "other"     | there is no volume other
StatefulSet replay    | /spec/serviceName                         | "other"     | there is no Service other
Deployment actor      | /spec/selector/matchLabels/more           | "label"     | selects other pods
Service learner       | /spec/selector/more                       | "label"     | means 0 workloads
Service learner       | /spec/ports/0/targetPort                  | "other"     | there is no port "other"
PodDisruptionBudget   | /spec/selector/matchLabels/more           | "label"     | selects no pods
Horizontal            | /spec/scaleTargetRef/name                 | "other"     | there is no Deployment other
Deployment actor      | /spec/replicas                            | 3           | would be undone by
StatefulSet replay    | /spec/replicas                            | 2           | knows 1 replay-servers of 2
ConfigMap run         | /data/replay                              | "replay:7001" | names all servers
ConfigMap run         | /data/replay                              | "replay-1.replay:7001" | there is no pod replay-1
ConfigMap run         | /data/learner                             | "learner:7001" | has no port 7001
ConfigMap run         | /data/learner                             | "teacher:7002" | there is no Service teacher
Job learner           | @/ports/0/containerPort                   | 7003        | listens at
StatefulSet replay    | @/args/2                                  | "--config=/etc/isodream/config/none.toml" | no volume has
Deployment actor      | @/env/3/value                             | "/etc/isodream/other" | no volume has
Secret learner        | /data/learner.token                       | -           | Job learner: has the secrets
Secret actor          | /data/learner.token                       | "eAo="      | Deployment actor: has the secrets
StatefulSet replay    | @/args/3                                  | "--dir=/replay" | no volume has /replay
NetworkPolicy actor   | /spec/egress/1/ports/0/port               | 7001        | actor to learner:7002: no NetworkPolicy lets it out
NetworkPolicy learner | /spec/ingress/0/ports/0/port              | 7001        | actor to learner:7002: no NetworkPolicy lets it in
NetworkPolicy replay  | /spec/ingress/0/from/0/podSelector        | {}          | evaluator to replay:7001: a NetworkPolicy lets it in
NetworkPolicy actor   | /spec/egress/0/ports                      | -           | actor to replay:9100: a NetworkPolicy lets it out
NetworkPolicy default | /spec/policyTypes                         | ["Egress"]  | actor to evaluator:1: a NetworkPolicy lets it in
NetworkPolicy names   | /spec/egress/0/ports/0/port               | 54          | ask for names
Job learner           | /spec/template/spec/securityContext/runAsNonRoot | -    | runAsNonRoot must be true
Job learner           | @/securityContext/capabilities/drop       | ["NET_RAW"] | must be {"drop":["ALL"]}
Job learner           | @/securityContext/readOnlyRootFilesystem  | false       | readOnlyRootFilesystem must be true
Job learner           | /spec/template/spec/terminationGracePeriodSeconds | 5   | must be 30
Job learner           | @/resources/limits/memory                 | -           | no memory among its limits
StatefulSet replay    | @/livenessProbe/exec/command/2            | "localhost:1" | livenessProbe must ask
ServiceAccount actor  | /automountServiceAccountToken             | true        | hands out its token
ServiceAccount actor  | /metadata/namespace                       | "default"   | is not in the namespace
Namespace isodream    | /metadata/labels/pod-security.kubernetes.io~1enforce | "baseline" | enforce `restricted`
ConfigMap run         | /data/run.toml                            | "[replay]\ncapacity_mb = 5000" | at most 4831 for a volume of 5Gi
ConfigMap run         | /data/run.toml                            | ""          | must be over 0
Horizontal            | /spec/metrics/0/external/metric/name      | "other"     | no rule makes `other`
Horizontal            | /spec/metrics                             | []          | asks for no metric
"#;

/// The small overlay, which is sound.
fn staged() -> (Manifests, Vec<Value>) {
    let root = fs::canonicalize(concat!(env!("CARGO_MANIFEST_DIR"), "/../..")).unwrap();
    let manifests = Manifests::stage(&root).unwrap();
    let validated = manifests.overlay("small").unwrap();
    assert_eq!(validated.problems, [""; 0]);
    assert_eq!(manifests.problems(Objects(&validated.objects)), [""; 0]);
    (manifests, validated.objects)
}

/// Holds each row of `table` against what `problems` finds in `objects` broken that way.
fn each(table: &str, objects: &[Value], problems: impl Fn(&[Value]) -> Vec<String>) {
    for row in table.trim().lines() {
        let [named, pointer, value, said] = row
            .splitn(4, '|')
            .map(str::trim)
            .collect::<Vec<_>>()
            .try_into()
            .unwrap();
        let pointer = pointer.replace('@', "/spec/template/spec/containers/0");
        let found = problems(&broken(objects, named, &pointer, value));
        assert!(
            found.iter().any(|problem| problem.contains(said)),
            "{row}: {found:#?}"
        );
    }
}

fn broken(objects: &[Value], named: &str, pointer: &str, value: &str) -> Vec<Value> {
    let mut objects = objects.to_vec();
    let object = objects
        .iter_mut()
        .find(|object| title(object).starts_with(named))
        .unwrap();
    let (parent, key) = pointer.rsplit_once('/').unwrap();
    match object.pointer_mut(parent).unwrap() {
        Value::Array(items) => {
            items[key.parse::<usize>().unwrap()] = serde_json::from_str(value).unwrap();
        }
        Value::Object(fields) if value == "-" => {
            fields.remove(key).unwrap();
        }
        fields => fields[key.replace("~1", "/")] = serde_json::from_str(value).unwrap(),
    }
    objects
}

#[test]
fn schemas_refuse_unknown_fields_wrong_types_and_old_kinds() {
    let (manifests, objects) = staged();
    each(REFUSED_BY_SCHEMAS, &objects, |objects| {
        let documents: String = objects
            .iter()
            .map(|object| format!("---\n{object}\n"))
            .collect();
        let validated = manifests.tools.validate(documents.as_bytes());
        validated.unwrap().problems
    });
}

#[test]
fn what_schemas_cannot_see_is_refused_by_name() {
    let (manifests, objects) = staged();
    each(REFUSED_BY_US, &objects, |objects| {
        manifests.problems(Objects(objects))
    });
}

#[test]
fn a_metric_that_nobody_exports_is_named() {
    let (mut manifests, objects) = staged();
    manifests
        .exported
        .retain(|name| name != "replay_insert_waiting");
    assert_eq!(
        manifests.problems(Objects(&objects)),
        ["monitoring/adapter-rules.yaml: no replay-server exports `replay_insert_waiting`"]
    );
}

#[test]
fn a_folder_that_kustomize_refuses_fails() {
    let (manifests, _) = staged();
    let secrets = manifests.folder.path().join("secrets");
    fs::remove_file(secrets.join("actor.token")).unwrap();
    let error = manifests.overlay("small").unwrap_err().to_string();
    assert!(error.contains("kubectl kustomize"), "{error}");
}

#[test]
fn an_isodream_that_does_not_take_the_commands_is_noticed() {
    let (_, objects) = staged();
    let objects = Objects(&objects);
    let work = tempfile::tempdir().unwrap();
    let refuses = |script: &str| {
        let path = work.path().join("isodream");
        fs::write(&path, format!("#!/bin/sh\n{script}\n")).unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        let isodream = Isodream {
            path: &path,
            root: work.path(),
        };
        let missing = isodream.makes_no(SECRETS).unwrap().unwrap();
        assert!(
            missing.starts_with("no ca.pem after isodream secrets"),
            "{missing}"
        );
        isodream.refuses(objects, work.path()).unwrap().join("\n")
    };
    let said = refuses("echo \"error: unexpected argument\" >&2; exit 2");
    for refused in [
        "StatefulSet replay: isodream replay --preset=quick --config=",
        "Job learner: isodream learner --supervised",
        "Deployment actor: isodream actor does not know ISODREAM_SECRETS",
        "StatefulSet replay: isodream health localhost:7001 --help: error: unexpected argument",
    ] {
        assert!(said.contains(refused), "{said}");
    }
    let takes_all =
        "echo '[env: ISODREAM_SECRETS=] --tls-ca learner.keep_checkpoints: must be at least 2'";
    assert_eq!(refuses(takes_all), "");
}
