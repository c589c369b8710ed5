//! Named ways to draw from the same chunks.

use crate::{ReplayError, Selector};

/// A name and a selector. Tables share the chunks and copy nothing; what a selector remembers (priorities, a
/// place in the queue) belongs to the table and the sequence length.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    /// The name.
    pub name: String,
    /// How it draws.
    pub selector: Selector,
}

impl Table {
    /// A table of that name.
    pub fn new(name: impl Into<String>, selector: Selector) -> Self {
        Self {
            name: name.into(),
            selector,
        }
    }

    /// Refuses a selector whose settings are out of range.
    ///
    /// # Errors
    /// [`ReplayError::InvalidTable`] says what is wrong.
    pub fn check(&self) -> Result<(), ReplayError> {
        match self.selector.fault() {
            Some(reason) => Err(ReplayError::InvalidTable {
                table: self.name.clone(),
                reason,
            }),
            None => Ok(()),
        }
    }
}
