//! `qedgix backup` and `qedgix restore`: the database of a server as one file.

use std::path::PathBuf;

use clap::Args;

use super::output::outln;
use crate::server::DataDir;
use crate::service::backup;

/// Flags of `backup`.
#[derive(Args, Debug)]
#[command(after_help = "The server may run meanwhile. The backup has jobs, policies and API keys as they were at one moment.

Example:
  qedgix backup /backups/qedgix-$(date +%F).sqlite --data-dir /var/lib/qedgix")]
pub struct BackupArgs {
    /// File to write; an existing one is replaced when the new one is complete. Only its owner can read it
    file: PathBuf,
    /// Data directory of the server
    #[arg(long, env = "QEDGIX_DATA_DIR", default_value = "./qedgix-data", value_name = "DIR")]
    data_dir: PathBuf,
}

/// Flags of `restore`.
#[derive(Args, Debug)]
#[command(after_help = "Stop the server first. A database that is replaced is kept as DIR/qedgix.sqlite.replaced.

Example:
  qedgix restore /backups/qedgix-2026-11-26.sqlite --data-dir /var/lib/qedgix --force")]
pub struct RestoreArgs {
    /// Backup to restore
    file: PathBuf,
    /// Data directory of the server; created if missing
    #[arg(long, env = "QEDGIX_DATA_DIR", default_value = "./qedgix-data", value_name = "DIR")]
    data_dir: PathBuf,
    /// Replace an existing database
    #[arg(long)]
    force: bool,
}

/// Makes a backup.
///
/// # Errors
/// The data directory has no database, or the file cannot be written.
pub async fn backup(args: BackupArgs) -> anyhow::Result<()> {
    let bytes = backup::backup(&args.data_dir, &args.file).await?;
    Ok(outln!("{} ({bytes} bytes)", args.file.display())?)
}

/// Restores a backup.
///
/// # Errors
/// A server uses the data directory, it has a database and `--force` is missing, or the file is not a complete backup.
pub async fn restore(args: RestoreArgs) -> anyhow::Result<()> {
    let _locked = DataDir::lock(&args.data_dir)?;
    backup::restore(&args.file, &args.data_dir, args.force).await?;
    Ok(outln!("{} is restored to {}", args.file.display(), args.data_dir.display())?)
}
