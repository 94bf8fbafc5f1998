//! The worker process: one attempt at one job, far from the server.

/// Environment variable that says where the server's gRPC is.
pub const ENV_SERVER: &str = "QEDGIX_SERVER";
/// Environment variable with the id of the job.
pub const ENV_JOB: &str = "QEDGIX_JOB";
/// Environment variable with the number of the attempt.
pub const ENV_ATTEMPT: &str = "QEDGIX_ATTEMPT";
/// Environment variable with the attempt's secret.
pub const ENV_TOKEN: &str = "QEDGIX_TOKEN";
