//! The error codes that clients see. A code is stable: programs compare codes, never messages.

use std::fmt;

use serde::{Deserialize, Serialize};

macro_rules! error_codes {
    ($($(#[$doc:meta])+ $variant:ident = $text:literal,)+) => {
        /// Says what kind of error occurred. The same on every transport.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
        pub enum ErrorCode {
            $($(#[$doc])+ #[serde(rename = $text)] $variant,)+
        }

        impl ErrorCode {
            /// Every code.
            pub const ALL: &'static [Self] = &[$(Self::$variant,)+];

            /// The code as clients see it, in snake case.
            pub const fn as_str(self) -> &'static str {
                match self {
                    $(Self::$variant => $text,)+
                }
            }
        }
    };
}

error_codes! {
    /// The alias does not point to the version that the caller expects.
    AliasMoved = "alias_moved",
    /// The resource exists and differs from the requested one.
    AlreadyExists = "already_exists",
    /// The attempt that a worker reports to has ended.
    AttemptOver = "attempt_over",
    /// The request comes from a page of another site, or names a host that the server does not go by.
    CrossSite = "cross_site",
    /// The caller's deadline passed.
    DeadlineExceeded = "deadline_exceeded",
    /// The server is shutting down.
    Draining = "draining",
    /// The environment expired because it was idle.
    EnvironmentExpired = "environment_expired",
    /// The episode has ended; a reset starts the next one.
    EpisodeOver = "episode_over",
    /// The idempotency key belongs to a job with another specification.
    IdempotencyConflict = "idempotency_conflict",
    /// The server failed. Its log has the cause.
    Internal = "internal",
    /// A field has a value that is not accepted.
    InvalidArgument = "invalid_argument",
    /// The request does not match its schema: a field is unknown, missing or of another type.
    InvalidSchema = "invalid_schema",
    /// The path does not support the HTTP method.
    MethodNotAllowed = "method_not_allowed",
    /// The policy is a baseline, which has no checkpoint and no aliases.
    NoCheckpoint = "no_checkpoint",
    /// The resource does not exist.
    NotFound = "not_found",
    /// The server holds as many bytes of requests and responses as it may; the caller may retry later.
    Overloaded = "overloaded",
    /// The API key lacks the required scope.
    PermissionDenied = "permission_denied",
    /// The policy is not loaded.
    PolicyUnloaded = "policy_unloaded",
    /// The server is a replica: changes of policies, and jobs, go to its primary.
    ReadOnly = "read_only",
    /// A limit is reached; the caller may retry later.
    ResourceExhausted = "resource_exhausted",
    /// A later run has taken over the session.
    RunFenced = "run_fenced",
    /// The request continues a sequence that has not started.
    SequenceNotStarted = "sequence_not_started",
    /// The session expired because it was idle.
    SessionExpired = "session_expired",
    /// The database cannot be written: its file is read-only, locked, deleted, or its disk fails.
    StorageFailed = "storage_failed",
    /// The database cannot be written: its disk is full.
    StorageFull = "storage_full",
    /// The request is larger than the limit.
    TooLarge = "too_large",
    /// The API key is missing, unknown, revoked or expired.
    Unauthenticated = "unauthenticated",
    /// The server is not ready: the database does not respond, or there is no policy.
    Unavailable = "unavailable",
    /// The body has a media type that the server does not read.
    UnsupportedMediaType = "unsupported_media_type",
    /// The resource is in a state that does not allow the operation.
    WrongState = "wrong_state",
    /// The step is neither the last nor the next one.
    WrongStep = "wrong_step",
}

impl fmt::Display for ErrorCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl AsRef<str> for ErrorCode {
    fn as_ref(&self) -> &str {
        self.as_str()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_distinct_and_in_snake_case() {
        let mut names: Vec<_> = ErrorCode::ALL.iter().map(|code| code.as_str()).collect();
        assert!(names.iter().all(|name| name.bytes().all(|b| b.is_ascii_lowercase() || b == b'_')));
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), ErrorCode::ALL.len());
    }

    #[test]
    fn json_has_the_same_text() {
        for code in ErrorCode::ALL {
            assert_eq!(serde_json::to_value(code).unwrap(), code.as_str());
        }
    }
}
