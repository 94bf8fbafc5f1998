//! The one error type of all use cases. Transports translate it; nobody else invents codes.

use std::time::Duration;

use crate::invalid::Invalid;

/// Why a use case did not do what was asked. Every variant has a stable [`Error::code`].
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Malformed or inconsistent input, or a size that does not fit the policy.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// A document that does not parse into its schema; the message says where.
    #[error("{0}")]
    Schema(String),
    /// No such thing.
    #[error("no {what} {id:?}")]
    NotFound {
        /// `policy`, `session`, `job`, ...
        what: &'static str,
        /// What was asked for.
        id: String,
    },
    /// It exists but is not in a state in which this can be done: `code` says which, `message` what to do.
    #[error("{message}")]
    Precondition {
        /// Stable code: `session_expired`, `run_fenced`, `wrong_step`, `wrong_state`, ...
        code: &'static str,
        /// What is the case and what would be.
        message: String,
    },
    /// It exists already and differs.
    #[error("{message}")]
    Conflict {
        /// Stable code: `idempotency_conflict`, `already_exists`.
        code: &'static str,
        /// What differs.
        message: String,
    },
    /// Too much at once; try again later.
    #[error("{message}")]
    Busy {
        /// Which limit.
        message: String,
        /// When to try again.
        retry_after: Duration,
    },
    /// A body or message over the limit.
    #[error("{0}")]
    TooLarge(String),
    /// A body of a kind that is not read here.
    #[error("{0}")]
    MediaType(String),
    /// The caller's deadline passed.
    #[error("the deadline passed {0}")]
    Deadline(&'static str),
    /// The server is shutting down.
    #[error("the server is draining; try again elsewhere or later")]
    Draining,
    /// No credentials, or wrong ones.
    #[error("{0}")]
    Unauthenticated(&'static str),
    /// Known, but not allowed.
    #[error("{0}")]
    PermissionDenied(String),
    /// A fault of ours. The cause is logged, not shown.
    #[error("internal error")]
    Internal(#[source] Box<dyn std::error::Error + Send + Sync>),
}

impl Error {
    /// Stable machine-readable code, the same on every transport.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Invalid(e) if !e.schema => "invalid_argument",
            Self::Invalid(_) | Self::Schema(_) => "invalid_schema",
            Self::NotFound { .. } => "not_found",
            Self::Precondition { code, .. } | Self::Conflict { code, .. } => code,
            Self::Busy { .. } => "resource_exhausted",
            Self::TooLarge(_) => "too_large",
            Self::MediaType(_) => "unsupported_media_type",
            Self::Deadline(_) => "deadline_exceeded",
            Self::Draining => "draining",
            Self::Unauthenticated(_) => "unauthenticated",
            Self::PermissionDenied(_) => "permission_denied",
            Self::Internal(_) => "internal",
        }
    }

    /// A fault of ours.
    pub fn internal(cause: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Self {
        Self::Internal(cause.into())
    }

    /// Too much at once, for about a second.
    pub fn busy(message: impl Into<String>) -> Self {
        Self::Busy { message: message.into(), retry_after: Duration::from_secs(1) }
    }

    /// No `what` called `id`.
    pub fn not_found(what: &'static str, id: impl Into<String>) -> Self {
        Self::NotFound { what, id: id.into() }
    }
}

impl From<crate::store::Error> for Error {
    fn from(error: crate::store::Error) -> Self {
        Self::internal(error)
    }
}
