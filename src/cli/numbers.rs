//! Numbers of flags: negative ones reach the flag, which refuses them by its name, and errors say what is expected.

use std::error::Error as _;
use std::num::{IntErrorKind, ParseFloatError, ParseIntError};

use clap::Command;
use clap::error::{ContextKind, ContextValue, ErrorKind};

/// The command, whose flags take negative numbers. Otherwise `-1` would be an unknown flag, in an error without the flag that it is for.
pub fn with_negative(command: Command) -> Command {
    let takes = |flag: &clap::Arg| !flag.is_positional() && flag.get_action().takes_values();
    command.mut_args(|flag| if takes(&flag) { flag.allow_negative_numbers(true) } else { flag }).mut_subcommands(with_negative)
}

/// The same error, with what is expected where the parser of a number does not say it.
pub fn explained(error: clap::Error) -> clap::Error {
    let text = |kind| match error.get(kind) {
        Some(ContextValue::String(text)) => text.clone(),
        _ => String::new(),
    };
    let (flag, value) = (text(ContextKind::InvalidArg), text(ContextKind::InvalidValue));
    let expected = match error.source() {
        Some(source) if source.is::<ParseFloatError>() => "a number",
        Some(source) => match source.downcast_ref::<ParseIntError>() {
            Some(parser) if *parser.kind() == IntErrorKind::PosOverflow => "a smaller number",
            // A signed number would have been accepted.
            Some(_) if value.parse::<i128>().is_ok_and(|number| number < 0) => "0 or more",
            Some(_) => "a whole number in digits, as 1000",
            None => return error,
        },
        None => return error,
    };
    let flag = flag.split_whitespace().next().unwrap_or_default();
    let message = format!("{flag}: got {value}, expected {expected}\n\nFor more information, try '--help'.\n");
    clap::Error::raw(ErrorKind::ValueValidation, message)
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;
    use crate::cli::Cli;

    fn refused(line: &str) -> String {
        let matches = with_negative(Cli::command()).try_get_matches_from(line.split(' '));
        explained(matches.expect_err("must be refused")).to_string()
    }

    #[test]
    fn errors_of_numbers_name_the_flag_and_what_is_expected() {
        for (line, message) in [
            ("qedgix train --seed -1", "--seed: got -1, expected 0 or more"),
            ("qedgix train --seed 1e3", "--seed: got 1e3, expected a whole number in digits"),
            ("qedgix train --seed 99999999999999999999", "--seed: got 99999999999999999999, expected a smaller number"),
            ("qedgix experiment e.toml --seeds a", "--seeds: got a, expected a whole number"),
            ("qedgix evaluate --policy x --uavs -2", "--uavs: got -2, expected 0 or more"),
            ("qedgix evaluate --policy x --position-noise a", "--position-noise: got a, expected a number"),
        ] {
            assert!(refused(line).contains(message), "{line}: {}", refused(line));
        }
        let steps = refused("qedgix train --steps -5");
        assert!(steps.contains("--steps") && steps.contains("0 or more"), "{steps}");
        assert!(refused("qedgix train --steps 1e30").contains("at most 2^53"));
        // These are numbers; the checks of values refuse them by name.
        for line in ["qedgix evaluate --policy x --position-noise -1", "qedgix plan --policy x --target-p95 -1"] {
            assert!(with_negative(Cli::command()).try_get_matches_from(line.split(' ')).is_ok(), "{line}");
        }
        assert!(refused("qedgix train --no-such-flag").contains("--no-such-flag"));
    }
}
