//! The filter of logs: `QEDGIX_LOG`. A filter that is not understood is an error: logs that are silent without a word are missed when
//! they are needed.

use tracing_subscriber::EnvFilter;
use tracing_subscriber::filter::{Directive, LevelFilter};

/// The variable of the filter.
const VARIABLE: &str = "QEDGIX_LOG";
/// The filter where the variable is empty or not set.
const DEFAULT: &str = "info";

/// A filter that is not understood.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{VARIABLE}: got {value:?}, in which {directive:?} is not understood; expected a level (error, warn, info, debug, trace or off), or \
     levels of targets after it, such as info,qedgix::jobs=debug"
)]
pub struct InvalidFilter {
    value: String,
    directive: String,
}

/// The filter of the environment.
pub(super) fn from_env() -> Result<EnvFilter, InvalidFilter> {
    parse(&std::env::var_os(VARIABLE).unwrap_or_default().to_string_lossy())
}

fn parse(text: &str) -> Result<EnvFilter, InvalidFilter> {
    let directives = || text.split(',').map(str::trim).filter(|directive| !directive.is_empty());
    // `EnvFilter` takes a word that is no level for a target, and then logs only that target.
    let is_understood =
        |text: &str| text.parse::<LevelFilter>().is_ok() || text.contains(['=', '[']) && text.parse::<Directive>().is_ok();
    if let Some(directive) = directives().find(|directive| !is_understood(directive)) {
        return Err(InvalidFilter { value: text.to_owned(), directive: directive.to_owned() });
    }
    let all = directives().collect::<Vec<_>>().join(",");
    Ok(EnvFilter::new(if all.is_empty() { DEFAULT } else { &all }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filters_are_levels_and_levels_of_targets() {
        for (text, filter) in [
            ("", "info"),
            (" , ", "info"),
            ("warn", "warn"),
            ("DEBUG", "debug"),
            ("off", "off"),
            ("info, qedgix::jobs=debug", "qedgix::jobs=debug,info"),
        ] {
            assert_eq!(parse(text).unwrap().to_string(), filter, "{text}");
        }
        assert!(parse("[request]=debug").is_ok());
    }

    #[test]
    fn what_is_not_understood_is_named() {
        for (text, directive) in [
            ("inf", "inf"),
            ("verbose", "verbose"),
            ("qedgix", "qedgix"),
            ("foo=bar=baz", "foo=bar=baz"),
            ("qedgix=loud", "qedgix=loud"),
            ("info,qedgix::jobs=debgu", "qedgix::jobs=debgu"),
        ] {
            let error = parse(text).unwrap_err();
            assert_eq!((error.value.as_str(), error.directive.as_str()), (text, directive));
            assert!(error.to_string().starts_with(&format!("QEDGIX_LOG: got {text:?}")), "{error}");
        }
    }
}
