//! The errors of `serving`. `service::Error` has a variant for each.

use crate::error_code::ErrorCode;
use crate::invalid::Invalid;

/// An error of `serving`.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The input is not accepted.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// The resource does not exist and did not expire recently.
    #[error("no {what} {id:?}")]
    Unknown {
        /// `policy`, `session`, ...
        what: &'static str,
        /// The name requested.
        id: String,
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
    Exists(String),
    /// A limit is reached; the caller may retry later.
    #[error("{0}")]
    Busy(String),
    /// The caller's deadline passed.
    #[error("the deadline passed {0}")]
    Deadline(&'static str),
    /// The server failed: a policy panicked, or the engine lost a request.
    #[error("{0}")]
    Fault(String),
}

impl Error {
    /// There is no `what` with this `id`.
    pub fn unknown(what: &'static str, id: impl Into<String>) -> Self {
        Self::Unknown { what, id: id.into() }
    }

    /// The resource is in a state that does not allow the operation.
    pub fn precondition(code: ErrorCode, message: impl Into<String>) -> Self {
        Self::Precondition { code, message: message.into() }
    }
}
