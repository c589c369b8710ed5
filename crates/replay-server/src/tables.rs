//! The tables that learners may name.

use anyhow::ensure;
use isodream_replay::Table;
use isodream_rpc::ServiceError;

/// A table and how its draws are accounted for.
#[derive(Debug, Clone, PartialEq)]
pub struct ServedTable {
    /// Name and selector.
    pub table: Table,
    /// Whether its draws count against the rate limiter and wait for it. Draws of others wait for the first
    /// steps only.
    pub limited: bool,
}

/// Tables of different names.
#[derive(Debug)]
pub(crate) struct Tables(Vec<ServedTable>);

impl Tables {
    pub(crate) fn new(tables: Vec<ServedTable>) -> anyhow::Result<Self> {
        for (at, served) in tables.iter().enumerate() {
            served.table.check()?;
            let name = &served.table.name;
            let is_new = tables[..at].iter().all(|other| other.table.name != *name);
            ensure!(
                is_new,
                "replay table `{name}` is configured twice; give each table its own name"
            );
        }
        Ok(Self(tables))
    }

    /// The table that a learner asks for.
    pub(crate) fn find(&self, name: &str) -> Result<&ServedTable, ServiceError> {
        let found = self.0.iter().find(|served| served.table.name == name);
        found.ok_or_else(|| {
            let known: Vec<_> = self
                .0
                .iter()
                .map(|served| served.table.name.as_str())
                .collect();
            ServiceError::Invalid(format!(
                "there is no replay table `{name}`; known: {}",
                known.join(", ")
            ))
        })
    }
}
