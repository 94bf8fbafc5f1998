//! Formats the fields of text log lines as `name=value`.
//!
//! Fields that only the trace export uses (`otel.*`) are left out. Control characters are escaped, because values may come from
//! callers and must not break lines or control a terminal.

use std::fmt::{self, Debug, Write};

use tracing::field::{Field, Visit};
use tracing_subscriber::field::RecordFields;
use tracing_subscriber::fmt::FormatFields;
use tracing_subscriber::fmt::format::Writer;

/// The field formatter of text logs.
#[derive(Debug)]
pub(super) struct TextFields;

impl<'writer> FormatFields<'writer> for TextFields {
    fn format_fields<R: RecordFields>(&self, line: Writer<'writer>, fields: R) -> fmt::Result {
        let mut visitor = FieldWriter { line, first: true, written: Ok(()) };
        fields.record(&mut visitor);
        visitor.written
    }
}

struct FieldWriter<'writer> {
    line: Writer<'writer>,
    first: bool,
    written: fmt::Result,
}

impl Visit for FieldWriter<'_> {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        let name = field.name();
        if name.starts_with("otel.") || self.written.is_err() {
            return;
        }
        let space = if std::mem::take(&mut self.first) { "" } else { " " };
        let mut line = EscapeControl(&mut self.line);
        self.written = match name {
            "message" => write!(line, "{space}{value:?}"),
            name => write!(line, "{space}{}={value:?}", name.trim_start_matches("r#")),
        };
    }
}

/// A writer that escapes control characters.
struct EscapeControl<W>(W);

impl<W: Write> Write for EscapeControl<W> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for piece in text.split_inclusive(char::is_control) {
            let mut rest = piece.chars();
            match rest.next_back().filter(|last| last.is_control()) {
                Some(last) => write!(self.0, "{}{}", rest.as_str(), last.escape_default())?,
                None => self.0.write_str(piece)?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_escaped() {
        let mut line = EscapeControl(String::new());
        line.write_str("a\nb\x1b[31mc\r\né\u{9b}").unwrap();
        assert_eq!(line.0, "a\\nb\\u{1b}[31mc\\r\\né\\u{9b}");
    }
}
