//! Standard output and standard error of all commands.
//!
//! `println!` panics when standard output is closed or its disk is full. `outln!` returns an [`OutputError`] instead, and
//! [`exit_code`] turns it into the exit status of the process.

use std::fmt::Arguments;
use std::io::{self, Write};
use std::process::ExitCode;

use crate::causes;

/// Prints a line to standard output. Returns `Result<(), OutputError>`.
macro_rules! outln {
    ($($arg:tt)*) => { $crate::cli::output::print_line(::std::format_args!($($arg)*)) };
}

/// Prints a line to standard error and ignores failures, because there is no other place to report them.
macro_rules! errln {
    ($($arg:tt)*) => { $crate::cli::output::print_error_line(::std::format_args!($($arg)*)) };
}

pub(super) use {errln, outln};

/// Exit status when the reader of standard output closed the pipe (`| head`): 128 + SIGPIPE, as shells report it.
const BROKEN_PIPE: u8 = 141;

/// Standard output cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write to standard output")]
pub struct OutputError(#[from] io::Error);

/// Ends the process with a status other than 1. The message is printed as it is; an empty one is not printed.
#[derive(Debug, thiserror::Error)]
#[error("{message}")]
pub struct Exit {
    /// The exit status.
    pub code: u8,
    /// The last line on standard error.
    pub message: String,
}

impl Exit {
    /// An exit with this status and message.
    pub fn new(code: u8, message: impl Into<String>) -> Self {
        Self { code, message: message.into() }
    }
}

/// Implements `outln!`.
///
/// # Errors
/// [`OutputError`] when the line cannot be written.
pub fn print_line(line: Arguments<'_>) -> Result<(), OutputError> {
    // One write of the whole line: readers never see half of it.
    let text = format!("{line}\n");
    let mut stdout = io::stdout().lock();
    stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()).map_err(OutputError)
}

/// Implements `errln!`.
pub fn print_error_line(line: Arguments<'_>) {
    let _ = io::stderr().write_all(format!("{line}\n").as_bytes());
}

/// The exit status of a command. Prints the error, except when the reader of standard output closed the pipe.
pub fn exit_code(result: anyhow::Result<()>) -> ExitCode {
    let Err(error) = result else { return ExitCode::SUCCESS };
    let output = error.downcast_ref::<OutputError>();
    if output.is_some_and(|error| error.0.kind() == io::ErrorKind::BrokenPipe) {
        return ExitCode::from(BROKEN_PIPE);
    }
    if let Some(Exit { code, message }) = error.downcast_ref::<Exit>() {
        if !message.is_empty() {
            print_error_line(format_args!("{message}"));
        }
        return ExitCode::from(*code);
    }
    print_error_line(format_args!("error: {}", causes::text(error.as_ref())));
    ExitCode::FAILURE
}

/// Prints a message of the argument parser: `--help` and `--version` to standard output, errors to standard error.
pub fn print_usage(message: &clap::Error) -> ExitCode {
    if message.use_stderr() {
        // As for other errors, there is no other place to report a failure.
        let _ = message.print();
        return ExitCode::from(u8::try_from(message.exit_code()).unwrap_or(1));
    }
    exit_code(message.print().map_err(|error| OutputError(error).into()))
}
