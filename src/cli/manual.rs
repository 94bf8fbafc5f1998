//! `qedgix completions` and `qedgix man`: what shells and `man` know about the command line. Packages contain their output.

use std::path::PathBuf;

use anyhow::Context;
use clap::{Args, Command};
use clap_complete::Shell;

use super::output::outln;

/// Flags of `completions`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  qedgix completions bash > ~/.local/share/bash-completion/completions/qedgix
  qedgix completions zsh > \"${fpath[1]}/_qedgix\"
  qedgix completions fish > ~/.config/fish/completions/qedgix.fish")]
pub struct CompletionsArgs {
    /// The shell
    #[arg(value_enum)]
    shell: Shell,
}

/// Flags of `man`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:\n  qedgix man target/man && man target/man/qedgix-serve.1")]
pub struct ManArgs {
    /// Directory for the pages; created if missing
    #[arg(value_name = "DIR")]
    directory: PathBuf,
}

/// Prints the completions of `cli` for a shell.
///
/// # Errors
/// Standard output cannot be written.
pub fn completions(args: &CompletionsArgs, cli: &mut Command) -> anyhow::Result<()> {
    let mut text = Vec::new();
    clap_complete::generate(args.shell, cli, "qedgix", &mut text);
    Ok(outln!("{}", String::from_utf8_lossy(&text).trim_end())?)
}

/// Writes the manual page of `cli`, and one of every command: `qedgix.1`, `qedgix-serve.1`, ...
///
/// # Errors
/// A file cannot be written.
pub fn man(args: &ManArgs, cli: Command) -> anyhow::Result<()> {
    let write = || {
        std::fs::create_dir_all(&args.directory)?;
        clap_mangen::generate_to(cli, &args.directory)
    };
    write().with_context(|| format!("cannot write to {}", args.directory.display()))
}
