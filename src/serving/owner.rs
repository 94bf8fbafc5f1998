//! Owners of sessions and environments.

use std::sync::Arc;

/// Who owns a session, an environment or a job: the API key that made it, or nobody on a server without keys. Two owners may
/// use the same names without seeing each other. Cheap to clone.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Owner(Option<Arc<str>>);

impl Owner {
    /// The owner of what is made on a server without keys.
    pub const NOBODY: Self = Self(None);

    /// The owner with this id. Keys that replace each other have the same owner.
    pub fn new(id: &str) -> Self {
        Self(Some(id.into()))
    }

    /// The id, or `None` for nobody.
    pub fn id(&self) -> Option<&str> {
        self.0.as_deref()
    }
}
