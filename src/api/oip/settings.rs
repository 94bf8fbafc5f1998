//! Settings of traces and logs, which the command line of the server determines: they can be read and not changed.

use crate::invalid::Invalid;
use crate::service::{App, Error};

/// The value of a setting of logs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LogSetting {
    /// True or false.
    Bool(bool),
    /// A number.
    Number(u32),
    /// A text.
    Text(String),
}

impl std::fmt::Display for LogSetting {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Bool(value) => value.fmt(f),
            Self::Number(value) => value.fmt(f),
            Self::Text(value) => write!(f, "{value:?}"),
        }
    }
}

/// The settings of traces. The server writes no trace files.
pub const TRACE_SETTINGS: [(&str, &str); 6] = [
    ("trace_file", ""),
    ("trace_level", "OFF"),
    ("trace_rate", "1000"),
    ("trace_count", "-1"),
    ("log_frequency", "0"),
    ("trace_mode", "triton"),
];

/// The settings of logs.
pub fn log_settings() -> [(&'static str, LogSetting); 6] {
    let verbose = u32::from(tracing::enabled!(tracing::Level::DEBUG)) + u32::from(tracing::enabled!(tracing::Level::TRACE));
    [
        ("log_file", LogSetting::Text(String::new())),
        ("log_info", LogSetting::Bool(tracing::enabled!(tracing::Level::INFO))),
        ("log_warning", LogSetting::Bool(tracing::enabled!(tracing::Level::WARN))),
        ("log_error", LogSetting::Bool(tracing::enabled!(tracing::Level::ERROR))),
        ("log_verbose_level", LogSetting::Number(verbose)),
        ("log_format", LogSetting::Text("default".to_owned())),
    ]
}

/// Checks the settings of traces that a request would set, for `model` or, if it is empty, for all models. No values: the default.
///
/// # Errors
/// [`Error::NotFound`] for an unknown model, [`Error::Invalid`] for a value other than the one that is set.
pub fn check_trace_settings(app: &App, model: &str, wanted: &[(String, Vec<String>)]) -> Result<(), Error> {
    if !model.is_empty() {
        super::statistics(app, model, "")?;
    }
    for (name, values) in wanted {
        let Some((_, current)) = TRACE_SETTINGS.iter().find(|(known, _)| known == name) else {
            return Err(unknown(name, TRACE_SETTINGS.iter().map(|(known, _)| *known)).into());
        };
        if !values.is_empty() && (values.len() != 1 || values[0] != *current) {
            let expected = format!("{current:?}: the server writes no trace files; serve --otlp-endpoint exports traces");
            return Err(Invalid::new(format!("settings.{name}"), format!("{values:?}"), expected).into());
        }
    }
    Ok(())
}

/// Checks the settings of logs that a request would set. No value: the default.
///
/// # Errors
/// [`Error::Invalid`] for a value other than the one that is set.
pub fn check_log_settings(wanted: &[(String, Option<LogSetting>)]) -> Result<(), Error> {
    let all = log_settings();
    for (name, value) in wanted {
        let Some((_, current)) = all.iter().find(|(known, _)| known == name) else {
            return Err(unknown(name, all.iter().map(|(known, _)| *known)).into());
        };
        if let Some(value) = value.as_ref().filter(|value| *value != current) {
            let expected = format!("{current}: QEDGIX_LOG and serve --log-format set what is logged");
            return Err(Invalid::new(format!("settings.{name}"), value, expected).into());
        }
    }
    Ok(())
}

fn unknown<'a>(name: &str, known: impl Iterator<Item = &'a str>) -> Invalid {
    Invalid::new("settings", format!("{name:?}"), format!("one of {}", known.collect::<Vec<_>>().join(", ")))
}
