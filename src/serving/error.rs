//! The errors of `serving`. `service::Error` has variants of the same names.

use crate::error_code::ErrorCode;
use crate::invalid::Invalid;

/// An error of `serving`.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The input is not accepted.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// The resource does not exist and did not expire recently.
    #[error("{}", not_found_message(what, id, near.as_deref()))]
    NotFound {
        /// `policy`, `session`, ...
        what: &'static str,
        /// The name requested.
        id: String,
        /// An existing name that is similar.
        near: Option<String>,
    },
    /// The resource is in a state that does not allow the operation.
    #[error("{message}")]
    Precondition {
        /// Names the state.
        code: ErrorCode,
        /// The state and what the caller can do.
        message: String,
    },
    /// The resource exists and differs from the requested one.
    #[error("{0}")]
    Conflict(String),
    /// A limit is reached; the caller may retry later.
    #[error("{0}")]
    Busy(String),
    /// The caller's deadline passed.
    #[error("the deadline passed {0}")]
    Deadline(&'static str),
    /// The server failed: a policy panicked, or the engine lost a request.
    #[error("{0}")]
    Internal(String),
}

/// The message about a resource that does not exist.
pub fn not_found_message(what: &str, id: &str, near: Option<&str>) -> String {
    match (what.split_once(' '), id.split_once([':', '@'])) {
        (Some((owner @ ("policy" | "model"), part @ ("version" | "alias"))), Some((name, value))) => {
            format!("{owner} {name} has no {part} {value}")
        }
        _ => format!("no {what} {id:?}{}", near.map_or_else(String::new, |near| format!("; did you mean {near}?"))),
    }
}

impl Error {
    /// There is no `what` with this `id`.
    pub fn not_found(what: &'static str, id: impl Into<String>) -> Self {
        Self::NotFound { what, id: id.into(), near: None }
    }

    /// The resource is in a state that does not allow the operation.
    pub fn precondition(code: ErrorCode, message: impl Into<String>) -> Self {
        Self::Precondition { code, message: message.into() }
    }
}
