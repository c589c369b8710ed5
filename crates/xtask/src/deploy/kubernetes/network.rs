//! What the NetworkPolicies let through: the connections that roles are told to make, and no other.

use serde_json::{Value, json};

use super::addresses::Flow;
use super::objects::{Objects, Workload, list, selects};

/// Where no role listens.
const UNUSED_PORT: u64 = 1;

/// Connections between pods that are needed and forbidden, or not needed and allowed at either end.
pub(super) fn problems(objects: Objects<'_>, needed: &[Flow<'_>]) -> Vec<String> {
    let mut found = Vec::new();
    for from in objects.workloads() {
        for to in objects.workloads() {
            // One that listens nowhere must not be reached at any port.
            let declared = to.ports().map(|(port, _)| port);
            let ports: Vec<u64> = declared.chain([UNUSED_PORT]).collect();
            for port in ports {
                let is_needed = needed.contains(&Flow {
                    from: from.name(),
                    to: to.name(),
                    port,
                });
                for (allowed, way) in [
                    (allows(objects, Direction::Egress, from, to, port), "out"),
                    (allows(objects, Direction::Ingress, to, from, port), "in"),
                ] {
                    let does = match (is_needed, allowed) {
                        (true, false) => "no",
                        (false, true) => "a",
                        _ => continue,
                    };
                    found.push(format!(
                        "{} to {}:{port}: {does} NetworkPolicy lets it {way}",
                        from.name(),
                        to.name()
                    ));
                }
            }
        }
        if !resolves_names(objects, from) {
            found.push(format!(
                "{}: no NetworkPolicy lets it ask for names",
                from.name()
            ));
        }
    }
    found
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Direction {
    Ingress,
    Egress,
}

impl Direction {
    /// Its name in `policyTypes`, its rules, and the peers of a rule.
    fn fields(self) -> (&'static str, &'static str, &'static str) {
        match self {
            Self::Ingress => ("Ingress", "ingress", "from"),
            Self::Egress => ("Egress", "egress", "to"),
        }
    }
}

/// The rules in one direction of all policies that select `pod`, or `None` where no policy does and all is allowed.
fn rules<'a>(
    objects: Objects<'a>,
    direction: Direction,
    pod: Workload<'_>,
) -> Option<Vec<&'a Value>> {
    let (kind, rules, _) = direction.fields();
    let policies: Vec<&Value> = objects
        .of_kind("NetworkPolicy")
        .filter(|policy| list(&policy["spec"]["policyTypes"]).contains(&json!(kind)))
        .filter(|policy| selects(&policy["spec"]["podSelector"], pod.labels()))
        .collect();
    if policies.is_empty() {
        return None;
    }
    let rules = policies
        .iter()
        .flat_map(|policy| list(&policy["spec"][rules]));
    Some(rules.collect())
}

/// Whether the policies of `pod` let it talk with `peer` in this direction; the port is the server's.
fn allows(
    objects: Objects<'_>,
    direction: Direction,
    pod: Workload<'_>,
    peer: Workload<'_>,
    port: u64,
) -> bool {
    let (_, _, peers) = direction.fields();
    let Some(rules) = rules(objects, direction, pod) else {
        return true;
    };
    rules.into_iter().any(|rule| {
        let peers = list(&rule[peers]);
        // A peer in another namespace is not one of these pods.
        let meant = peers.is_empty()
            || peers.iter().any(|meant| {
                meant["namespaceSelector"].is_null()
                    && meant
                        .get("podSelector")
                        .is_some_and(|selector| selects(selector, peer.labels()))
            });
        let ports = list(&rule["ports"]);
        meant && (ports.is_empty() || ports.iter().any(|allowed| allowed["port"] == port))
    })
}

fn resolves_names(objects: Objects<'_>, pod: Workload<'_>) -> bool {
    let Some(rules) = rules(objects, Direction::Egress, pod) else {
        return true;
    };
    ["UDP", "TCP"].iter().all(|protocol| {
        let port = json!({"protocol": protocol, "port": 53});
        rules
            .iter()
            .any(|rule| list(&rule["ports"]).contains(&port))
    })
}
