//! Why serving could not answer.

use crate::invalid::Invalid;

/// Why serving could not answer; `service` turns it into the one error type of all use cases.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Input that cannot be used.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// Nothing of this name, and nothing that expired lately.
    #[error("no {what} {id:?}")]
    Unknown {
        /// `policy`, `session`, ...
        what: &'static str,
        /// What was asked for.
        id: String,
    },
    /// It exists, but not in a state in which this can be done.
    #[error("{message}")]
    Precondition {
        /// Stable code.
        code: &'static str,
        /// What is the case and what would be.
        message: String,
    },
    /// It exists already and differs.
    #[error("{0}")]
    Exists(String),
    /// A limit is reached; trying again later may help.
    #[error("{0}")]
    Busy(String),
    /// The caller's deadline passed.
    #[error("the deadline passed {0}")]
    Deadline(&'static str),
    /// A policy did not keep its word (it panicked or is gone).
    #[error("{0}")]
    Fault(String),
}

impl Error {
    /// No `what` called `id`.
    pub fn unknown(what: &'static str, id: impl Into<String>) -> Self {
        Self::Unknown { what, id: id.into() }
    }

    /// A state in which this cannot be done.
    pub fn precondition(code: &'static str, message: impl Into<String>) -> Self {
        Self::Precondition { code, message: message.into() }
    }
}
