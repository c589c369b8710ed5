//! The rules on dependencies, checked on what cargo itself resolved.

use std::collections::{HashMap, HashSet};
use std::path::Path;

use anyhow::{Context, Result, bail};
use serde_json::Value;

use crate::stage::{cargo, output};

/// Crates in the order of ARCHITECTURE.md: one may use those of earlier rows, never of its own.
const LAYERS: &[&[&str]] = &[
    &["isodream-core"],
    &["isodream-proto"],
    &["isodream-envs"],
    &["isodream-replay"],
    &["isodream-model"],
    &["isodream-rpc"],
    &["isodream-telemetry"],
    &["isodream-dashboard"],
    &[
        "isodream-replay-server",
        "isodream-actor",
        "isodream-learner",
    ],
    &["isodream"],
    &["isodream-chaos"],
    &["isodream-tests"],
];
/// Free of libtorch, so that they build fast and run where it is not.
const WITHOUT_TORCH: &[&str] = &[
    "isodream-core",
    "isodream-proto",
    "isodream-envs",
    "isodream-replay",
    "isodream-rpc",
    "isodream-telemetry",
    "isodream-dashboard",
    "isodream-replay-server",
    "isodream-chaos",
    "xtask",
];
const TORCH: &[&str] = &["tch", "torch-sys"];
/// TLS is rustls here; these need a system OpenSSL.
const BANNED: &[&str] = &["openssl-sys", "native-tls"];
/// How cargo names crates.io as a source, whatever mirror it fetches from.
const REGISTRY: &str = "/rust-lang/crates.io-index";

/// Checks all rules and reports every violation at once.
pub(crate) fn check(root: &Path) -> Result<()> {
    let args = ["metadata", "--format-version", "1", "--locked"];
    let metadata = serde_json::from_slice(&output(&mut cargo(root, args))?)?;
    let violations = violations(&Graph::new(&metadata)?);
    if !violations.is_empty() {
        bail!("{}", violations.join("\n"));
    }
    Ok(())
}

/// The packages that cargo resolved, by id.
struct Graph {
    packages: HashMap<String, Package>,
}

struct Package {
    name: String,
    /// Absent for the packages of the workspace.
    source: Option<String>,
    /// Ids of normal and build dependencies; tests may use what they like.
    dependencies: Vec<String>,
}

impl Graph {
    fn new(metadata: &Value) -> Result<Self> {
        let list = |value: &Value| value.as_array().cloned().unwrap_or_default();
        let text = |value: &Value| value.as_str().map(str::to_owned);
        let mut dependencies = HashMap::new();
        for node in list(&metadata["resolve"]["nodes"]) {
            let used = list(&node["deps"]).into_iter().filter(|dependency| {
                list(&dependency["dep_kinds"])
                    .iter()
                    .any(|kind| kind["kind"] != "dev")
            });
            let ids: Vec<String> = used
                .filter_map(|dependency| text(&dependency["pkg"]))
                .collect();
            dependencies.insert(text(&node["id"]), ids);
        }
        let mut packages = HashMap::new();
        for package in list(&metadata["packages"]) {
            let id = text(&package["id"]).context("cargo metadata lists a package without id")?;
            let name =
                text(&package["name"]).with_context(|| format!("package {id} has no name"))?;
            let source = text(&package["source"]);
            let dependencies = dependencies.remove(&Some(id.clone())).unwrap_or_default();
            packages.insert(
                id,
                Package {
                    name,
                    source,
                    dependencies,
                },
            );
        }
        Ok(Self { packages })
    }

    fn direct<'a>(&'a self, package: &'a Package) -> impl Iterator<Item = &'a Package> {
        package
            .dependencies
            .iter()
            .filter_map(|id| self.packages.get(id))
    }

    /// The names from `package` down to the first of `targets`, where one is reached.
    fn path_to<'a>(
        &'a self,
        package: &'a Package,
        targets: &[&str],
        seen: &mut HashSet<&'a str>,
    ) -> Option<Vec<&'a str>> {
        if targets.contains(&package.name.as_str()) {
            return Some(vec![&package.name]);
        }
        for id in &package.dependencies {
            if !seen.insert(id) {
                continue;
            }
            let path = self
                .packages
                .get(id)
                .and_then(|next| self.path_to(next, targets, seen));
            if let Some(mut path) = path {
                path.insert(0, &package.name);
                return Some(path);
            }
        }
        None
    }
}

fn layer(name: &str) -> Option<usize> {
    LAYERS.iter().position(|row| row.contains(&name))
}

fn violations(graph: &Graph) -> Vec<String> {
    let mut found = Vec::new();
    for package in graph.packages.values() {
        let name = package.name.as_str();
        if BANNED.contains(&name) {
            found.push(format!(
                "{name} is banned: find what pulls it in with `cargo tree -i {name}`"
            ));
        }
        if let Some(source) = &package.source {
            if !source.ends_with(REGISTRY) {
                found.push(format!("{name} comes from {source}: use crates.io"));
            }
            continue;
        }
        for dependency in graph
            .direct(package)
            .filter(|dependency| dependency.source.is_none())
        {
            let allowed = match (layer(name), layer(&dependency.name)) {
                (Some(user), Some(used)) => used < user,
                // What is in no row (xtask, the test package) is used by nobody and uses nobody.
                _ => false,
            };
            if !allowed {
                found.push(format!(
                    "{name} may not depend on {}: a crate uses only those above it in ARCHITECTURE.md",
                    dependency.name
                ));
            }
        }
        if WITHOUT_TORCH.contains(&name)
            && let Some(path) = graph.path_to(package, TORCH, &mut HashSet::new())
        {
            found.push(format!(
                "{name} must stay free of libtorch: {}",
                path.join(" -> ")
            ));
        }
    }
    found.sort();
    found
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    const CRATES_IO: &str = "registry+somewhere/rust-lang/crates.io-index";

    type Dependencies<'a> = &'a [(&'a str, Option<&'a str>)];

    /// Violations in a workspace of `(name, source, [(dependency, kind)])`.
    fn check(packages: &[(&str, Option<&str>, Dependencies<'_>)]) -> Vec<String> {
        let listed = packages
            .iter()
            .map(|(name, source, _)| json!({"id": name, "name": name, "source": source}));
        let nodes = packages.iter().map(|(name, _, dependencies)| {
            let deps = dependencies.iter().map(
                |(dependency, kind)| json!({"pkg": dependency, "dep_kinds": [{"kind": kind}]}),
            );
            json!({"id": name, "deps": deps.collect::<Vec<_>>()})
        });
        let metadata = json!({
            "packages": listed.collect::<Vec<_>>(),
            "resolve": {"nodes": nodes.collect::<Vec<_>>()},
        });
        violations(&Graph::new(&metadata).unwrap())
    }

    #[test]
    fn using_an_upper_crate_is_fine() {
        let model: (_, _, &[_]) = (
            "isodream-model",
            None,
            &[("isodream-core", None), ("tch", None)],
        );
        let found = check(&[
            model,
            ("isodream-core", None, &[]),
            ("tch", Some(CRATES_IO), &[]),
        ]);
        assert_eq!(found, [""; 0]);
    }

    #[test]
    fn using_a_lower_crate_or_a_sibling_is_not() {
        let found = check(&[
            ("isodream-core", None, &[("isodream-envs", None)]),
            ("isodream-envs", None, &[]),
            ("isodream-actor", None, &[("isodream-learner", None)]),
            ("isodream-learner", None, &[]),
        ]);
        assert_eq!(found.len(), 2, "{found:?}");
        assert!(found[0].starts_with("isodream-actor may not depend on isodream-learner"));
        assert!(found[1].starts_with("isodream-core may not depend on isodream-envs"));
    }

    #[test]
    fn torch_is_found_through_others_but_not_through_tests() {
        let torch: (_, _, &[_]) = ("torch-sys", Some(CRATES_IO), &[]);
        let between: (_, _, &[_]) = ("between", Some(CRATES_IO), &[("torch-sys", Some("build"))]);
        let found = check(&[
            torch,
            between,
            ("isodream-envs", None, &[("between", None)]),
        ]);
        assert_eq!(
            found,
            ["isodream-envs must stay free of libtorch: isodream-envs -> between -> torch-sys"]
        );
        let found = check(&[
            torch,
            between,
            ("isodream-envs", None, &[("between", Some("dev"))]),
        ]);
        assert_eq!(found, [""; 0]);
    }

    #[test]
    fn foreign_sources_and_banned_crates_are_named() {
        let found = check(&[
            ("a", Some("git+ssh://somewhere/a"), &[]),
            ("openssl-sys", Some(CRATES_IO), &[]),
        ]);
        assert_eq!(found.len(), 2, "{found:?}");
        assert!(found[0].starts_with("a comes from git+ssh://somewhere/a"));
        assert!(found[1].starts_with("openssl-sys is banned"));
    }
}
