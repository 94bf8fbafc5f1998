//! Flags of `serve` for replicas.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;

use crate::cli::connect::{ConnectArgs, Secret};
use crate::config::FollowConfig;

/// Heading of these flags in the help.
const REPLICA: &str = "Replica";

/// Flags of `serve` for replicas.
#[derive(Args, Debug)]
pub(super) struct FollowArgs {
    /// Be a replica: take policies, versions and aliases from the server at this REST address, and refuse changes and jobs here
    /// [default: no replica]
    #[arg(long, help_heading = REPLICA, env = "QEDGIX_FOLLOW", value_name = "HOST:PORT")]
    follow: Option<String>,
    /// API key of that server with the scope read; prefer the variable or the file, because every user of this machine can see command
    /// lines [default: none]
    #[arg(
        long, help_heading = REPLICA, env = "QEDGIX_FOLLOW_API_KEY", hide_env_values = true, requires = "follow",
        conflicts_with = "follow_api_key_file", value_name = "KEY"
    )]
    follow_api_key: Option<Secret>,
    /// File with that API key [default: none]
    #[arg(long, help_heading = REPLICA, env = "QEDGIX_FOLLOW_API_KEY_FILE", requires = "follow", value_name = "FILE")]
    follow_api_key_file: Option<PathBuf>,
    /// Certificate authorities to trust for that server (PEM) [default: those of this machine]
    #[arg(long, help_heading = REPLICA, env = "QEDGIX_FOLLOW_CA_CERT", requires = "follow", value_name = "FILE")]
    follow_ca_cert: Option<PathBuf>,
    /// Client certificate for that server (PEM) [default: none]
    #[arg(long, help_heading = REPLICA, env = "QEDGIX_FOLLOW_CLIENT_CERT", requires = "follow_client_key", value_name = "FILE")]
    follow_client_cert: Option<PathBuf>,
    /// Private key of the client certificate (PEM)
    #[arg(long, help_heading = REPLICA, env = "QEDGIX_FOLLOW_CLIENT_KEY", requires = "follow_client_cert", value_name = "FILE")]
    follow_client_key: Option<PathBuf>,
}

impl FollowArgs {
    /// How to reach the primary, if there is one.
    ///
    /// # Errors
    /// The address is malformed, or the key or a certificate cannot be read.
    pub(super) fn config(&self) -> anyhow::Result<Option<FollowConfig>> {
        let Some(address) = &self.follow else { return Ok(None) };
        let api_key = match &self.follow_api_key_file {
            Some(file) => {
                let key = std::fs::read_to_string(file).with_context(|| format!("--follow-api-key-file {}", file.display()))?;
                Some(Secret::from(key))
            }
            None => self.follow_api_key.clone(),
        };
        let connect = ConnectArgs::of_follow(
            api_key,
            self.follow_ca_cert.clone(),
            self.follow_client_cert.clone().zip(self.follow_client_key.clone()),
        );
        let url = connect.url(address).context("--follow")?;
        let (authorization, tls) = (connect.authorization(&url)?, connect.tls(&url)?);
        Ok(Some(FollowConfig { url: url.to_string().trim_end_matches('/').to_owned(), authorization, tls }))
    }
}
