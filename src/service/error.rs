//! The error type of all use cases. The transports translate it; only this file assigns codes to variants.

use std::time::Duration;

use crate::causes;
use crate::error_code::ErrorCode;
use crate::inflight::Exhausted;
use crate::invalid::Invalid;
use crate::store::WriteFailure;

/// An error of a use case. [`Error::code`] has the code that clients see.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The input does not match its schema, or a value is not accepted.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// The resource does not exist.
    #[error("{}", crate::serving::not_found_message(what, id, near.as_deref()))]
    NotFound {
        /// `policy`, `session`, `job`, ...
        what: &'static str,
        /// The name or id requested.
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
    /// This server is a replica, which changes no policies and has no jobs.
    #[error("this server is a replica of {primary} and changes nothing itself; send the request to {primary}")]
    ReadOnly {
        /// REST address of the primary.
        primary: String,
    },
    /// The resource exists and differs from the requested one.
    #[error("{message}")]
    Conflict {
        /// [`ErrorCode::AlreadyExists`] or [`ErrorCode::IdempotencyConflict`].
        code: ErrorCode,
        /// The difference.
        message: String,
    },
    /// A limit is reached; the caller may retry later.
    #[error("{message}")]
    Busy {
        /// The limit.
        message: String,
        /// Time after which to retry.
        retry_after: Duration,
    },
    /// The server holds as many bytes of requests and responses as it may, or as many connections.
    #[error("the server holds as many requests and responses as it may; retry later")]
    Overloaded,
    /// The body or message is larger than the limit.
    #[error("{message}")]
    TooLarge {
        /// The limit, in words.
        message: String,
        /// The limit in bytes, where known.
        limit: Option<u64>,
    },
    /// The body has a media type that the server does not read.
    #[error(transparent)]
    MediaType(Invalid),
    /// The request comes from a page of another site, or names a host that the server does not go by.
    #[error(transparent)]
    CrossSite(Invalid),
    /// The caller's deadline passed.
    #[error("the deadline passed {0}")]
    Deadline(&'static str),
    /// The server is shutting down.
    #[error("the server is shutting down; retry later or on another server")]
    Draining,
    /// The server is not ready: the database does not respond, or there is no policy.
    #[error("{0}")]
    Unavailable(&'static str),
    /// The database cannot be written. Nothing was stored; the caller may retry later.
    #[error("{}; nothing was stored", .0.reason())]
    Storage(WriteFailure),
    /// The API key is missing, unknown, revoked or expired.
    #[error("{0}")]
    Unauthenticated(&'static str),
    /// The API key lacks the required scope.
    #[error("{message}")]
    PermissionDenied {
        /// The required scope and those of the key.
        message: String,
        /// The required scope.
        scope: &'static str,
    },
    /// The server failed. Clients do not see the cause; it is logged.
    #[error("internal error")]
    Internal(#[source] Box<dyn std::error::Error + Send + Sync>),
}

impl Error {
    /// The code that clients see, the same on every transport.
    pub fn code(&self) -> ErrorCode {
        match self {
            Self::Invalid(invalid) if invalid.is_schema() => ErrorCode::InvalidSchema,
            Self::Invalid(_) => ErrorCode::InvalidArgument,
            Self::NotFound { .. } => ErrorCode::NotFound,
            Self::Precondition { code, .. } | Self::Conflict { code, .. } => *code,
            Self::ReadOnly { .. } => ErrorCode::ReadOnly,
            Self::Busy { .. } => ErrorCode::ResourceExhausted,
            Self::Overloaded => ErrorCode::Overloaded,
            Self::TooLarge { .. } => ErrorCode::TooLarge,
            Self::MediaType(_) => ErrorCode::UnsupportedMediaType,
            Self::CrossSite(_) => ErrorCode::CrossSite,
            Self::Deadline(_) => ErrorCode::DeadlineExceeded,
            Self::Draining => ErrorCode::Draining,
            Self::Unavailable(_) => ErrorCode::Unavailable,
            Self::Storage(WriteFailure::Full) => ErrorCode::StorageFull,
            Self::Storage(_) => ErrorCode::StorageFailed,
            Self::Unauthenticated(_) => ErrorCode::Unauthenticated,
            Self::PermissionDenied { .. } => ErrorCode::PermissionDenied,
            Self::Internal(_) => ErrorCode::Internal,
        }
    }

    /// Why the server failed, with all causes, or the message of another error. For logs only.
    pub fn reason(&self) -> String {
        std::error::Error::source(self).map_or_else(|| self.to_string(), causes::text)
    }

    /// The field that is not accepted, if the error is about one.
    pub fn invalid(&self) -> Option<&Invalid> {
        match self {
            Self::Invalid(invalid) | Self::MediaType(invalid) | Self::CrossSite(invalid) => Some(invalid),
            _ => None,
        }
    }

    /// The server failed because of `cause`.
    pub fn internal(cause: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Self {
        Self::Internal(cause.into())
    }

    /// A limit is reached; the caller may retry after a second.
    pub fn busy(message: impl Into<String>) -> Self {
        Self::Busy { message: message.into(), retry_after: Duration::from_secs(1) }
    }

    /// There is no `what` with this `id`.
    pub fn not_found(what: &'static str, id: impl Into<String>) -> Self {
        Self::NotFound { what, id: id.into(), near: None }
    }
}

impl From<Exhausted> for Error {
    fn from(_: Exhausted) -> Self {
        Self::Overloaded
    }
}

impl From<crate::store::Error> for Error {
    fn from(error: crate::store::Error) -> Self {
        match error.write_failure() {
            Some(failure) => Self::Storage(failure),
            None => Self::internal(error),
        }
    }
}
