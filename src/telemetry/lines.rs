//! How fields are written in lines for people: as `name=value`, without those that are for the export of traces alone, and
//! without control characters: what callers send neither breaks a line nor moves a terminal's cursor.

use std::fmt::{self, Debug, Write};

use tracing::field::{Field, Visit};
use tracing_subscriber::field::RecordFields;
use tracing_subscriber::fmt::FormatFields;
use tracing_subscriber::fmt::format::Writer;

/// Writes fields.
#[derive(Debug)]
pub(super) struct Fields;

impl<'writer> FormatFields<'writer> for Fields {
    fn format_fields<R: RecordFields>(&self, line: Writer<'writer>, fields: R) -> fmt::Result {
        let mut visitor = Visitor { line, first: true, written: Ok(()) };
        fields.record(&mut visitor);
        visitor.written
    }
}

struct Visitor<'writer> {
    line: Writer<'writer>,
    first: bool,
    written: fmt::Result,
}

impl Visit for Visitor<'_> {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        let name = field.name();
        if name.starts_with("otel.") || self.written.is_err() {
            return;
        }
        let space = if std::mem::take(&mut self.first) { "" } else { " " };
        let mut line = Harmless(&mut self.line);
        self.written = match name {
            "message" => write!(line, "{space}{value:?}"),
            name => write!(line, "{space}{}={value:?}", name.trim_start_matches("r#")),
        };
    }
}

/// Escapes control characters.
struct Harmless<W>(W);

impl<W: Write> Write for Harmless<W> {
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
        let mut line = Harmless(String::new());
        line.write_str("a\nb\x1b[31mc\r\né\u{9b}").unwrap();
        assert_eq!(line.0, "a\\nb\\u{1b}[31mc\\r\\né\\u{9b}");
    }
}
