//! `qedgix backup` and `qedgix restore`: the database of a server as one file.

use std::path::PathBuf;

use clap::Args;

use super::output::{errln, outln};
use crate::server::DataDir;
use crate::service::backup::{self, Backup, Restore};

/// Flags of `backup`.
#[derive(Args, Debug)]
#[command(
    after_help = "The server may run meanwhile. The backup has jobs, policies and API keys as they were at one moment. If a
policy in the database is damaged, the backup is written all the same, and a warning names the policy.

Example:
  qedgix backup /backups/qedgix-$(date +%F).sqlite --data-dir /var/lib/qedgix"
)]
pub struct BackupArgs {
    /// File to write; an existing one is replaced when the new one is complete, and nothing else than a file is replaced. Only its owner
    /// can read it
    file: PathBuf,
    /// Data directory of the server
    #[arg(long, env = "QEDGIX_DATA_DIR", default_value = "./qedgix-data", value_name = "DIR")]
    data_dir: PathBuf,
}

/// Flags of `restore`.
#[derive(Args, Debug)]
#[command(after_help = "Stop the server first. A database that is replaced is kept as DIR/qedgix.sqlite.replaced.
Run this as the user of the server. As root, the database is given to the owner of DIR.

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
    /// Restore what can be read of a damaged backup; policies that are damaged stay so
    #[arg(long)]
    accept_damage: bool,
}

/// Makes a backup.
///
/// # Errors
/// The data directory has no database, or the file cannot be written.
pub async fn backup(args: BackupArgs) -> anyhow::Result<()> {
    let Backup { bytes, damage } = backup::backup(&args.data_dir, &args.file).await?;
    for damage in damage {
        errln!("warning: the database is damaged, and so is the backup: {damage}");
    }
    Ok(outln!("{} ({bytes} bytes)", args.file.display())?)
}

/// Restores a backup.
///
/// # Errors
/// A server uses the data directory, it has a database and `--force` is missing, or the file is not a complete backup.
pub async fn restore(args: RestoreArgs) -> anyhow::Result<()> {
    let _locked = DataDir::lock(&args.data_dir)?;
    let options = Restore { force: args.force, accept_damage: args.accept_damage };
    for damage in backup::restore(&args.file, &args.data_dir, options).await? {
        errln!("warning: the backup is damaged, and so is the database: {damage}");
    }
    Ok(outln!("{} is restored to {}", args.file.display(), args.data_dir.display())?)
}
