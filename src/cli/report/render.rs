//! Renders a report as a self-contained HTML page, and as Markdown with the plots beside it. Names come from users and are escaped.

use std::fmt::Write;

use crate::experiment::figure_link;

/// A report.
pub(super) struct ReportPage {
    pub(super) title: String,
    /// The command that repeats the evaluation.
    pub(super) command: String,
    pub(super) sections: Vec<ReportSection>,
}

/// A section of the page.
pub(super) struct ReportSection {
    pub(super) title: String,
    pub(super) text: String,
    pub(super) table: Option<ReportTable>,
    pub(super) plots: Vec<ReportPlot>,
}

/// A table. Rows have the width of the header; columns from `numbers_from` on are aligned right.
pub(super) struct ReportTable {
    pub(super) header: Vec<String>,
    pub(super) rows: Vec<Vec<String>>,
    pub(super) numbers_from: usize,
}

/// A plot and its file.
pub(super) struct ReportPlot {
    pub(super) file: String,
    pub(super) caption: String,
    pub(super) svg: String,
}

const STYLE: &str = "
:root { color-scheme: light dark; --paper: #fff; --ink: #222; --line: #e4e4e4; --quiet: #666; --code: #f6f6f6; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #15181c; --ink: #e6e6e6; --line: #31363d; --quiet: #9aa0a8; --code: #1f242a; }
}
body { margin: 0 auto; max-width: 94rem; padding: 2rem 1.5rem 4rem; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif; }
h1 { font-size: 1.8rem; margin: 0 0 1rem; }
h2 { font-size: 1.25rem; margin: 2.5rem 0 .5rem; padding-top: 1rem; border-top: 1px solid var(--line); }
p { max-width: 48rem; margin: .5rem 0 1rem; }
pre { background: var(--code); padding: .7rem 1rem; border-radius: 6px; white-space: pre-wrap; overflow-wrap: anywhere; }
.wide { overflow-x: auto; max-width: 100%; }
table { border-collapse: collapse; margin: 0 0 1.2rem; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .9rem; text-align: left; border-bottom: 1px solid var(--line); min-width: 4.5rem; overflow-wrap: anywhere; }
th { border-bottom: 2px solid var(--quiet); font-weight: 600; }
.n { text-align: right; white-space: nowrap; }
.row { display: flex; flex-wrap: wrap; gap: 1rem 2rem; align-items: flex-start; }
figure { margin: 0; max-width: 100%; }
figure svg { max-width: 100%; height: auto; display: block; }
figcaption { color: var(--quiet); font-size: .9rem; padding-left: 1rem; overflow-wrap: anywhere; }
footer { margin-top: 3rem; color: var(--quiet); font-size: .9rem; }
";

/// The report as HTML.
pub(super) fn html(document: &ReportPage) -> String {
    let title = escaped_html(&document.title);
    let mut page = format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<title>{title}</title>\n\
         <style>{STYLE}</style>\n</head>\n<body>\n<h1>{title}</h1>\n<pre>{}</pre>\n",
        escaped_html(&document.command)
    );
    for section in &document.sections {
        let _ = write!(page, "<h2>{}</h2>\n<p>{}</p>\n", escaped_html(&section.title), code(&escaped_html(&section.text)));
        page += "<div class=\"row\">\n";
        page += &section.table.as_ref().map(html_table).unwrap_or_default();
        for plot in &section.plots {
            let caption = escaped_html(&plot.caption);
            let _ = write!(page, "<figure>\n{}<figcaption>{caption}</figcaption>\n</figure>\n", plot.svg);
        }
        page += "</div>\n";
    }
    page + &format!("<footer>qedgix {}</footer>\n</body>\n</html>\n", env!("CARGO_PKG_VERSION"))
}

fn html_table(table: &ReportTable) -> String {
    let cells = |row: &[String], tag: &str| -> String {
        let cell = |(i, text): (usize, &String)| {
            let class = if i >= table.numbers_from { " class=\"n\"" } else { "" };
            format!("<{tag}{class}>{}</{tag}>", escaped_html(text))
        };
        format!("<tr>{}</tr>\n", row.iter().enumerate().map(cell).collect::<String>())
    };
    let rows: String = table.rows.iter().map(|row| cells(row, "td")).collect();
    format!("<div class=\"wide\"><table>\n<thead>{}</thead>\n<tbody>{rows}</tbody>\n</table></div>\n", cells(&table.header, "th"))
}

/// The report as Markdown.
pub(super) fn markdown(document: &ReportPage) -> String {
    let mut text = format!("# {}\n\n```sh\n{}\n```\n", document.title, document.command.replace("```", "'''"));
    for section in &document.sections {
        let _ = write!(text, "\n## {}\n\n{}\n", escaped_markdown(&section.title), section.text);
        if let Some(table) = &section.table {
            let line = |cells: Vec<String>| format!("| {} |\n", cells.join(" | "));
            text += "\n";
            text += &line(table.header.iter().map(|c| escaped_markdown(c)).collect());
            text +=
                &line((0..table.header.len()).map(|i| if i < table.numbers_from { ":--" } else { "--:" }.to_owned()).collect());
            text.extend(table.rows.iter().map(|row| line(row.iter().map(|c| escaped_markdown(c)).collect())));
        }
        for plot in &section.plots {
            let _ = writeln!(text, "\n{}", figure_link(&escaped_markdown(&plot.caption), &plot.file));
        }
    }
    text
}

/// `text` escaped for HTML elements and attributes.
fn escaped_html(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '<' => out += "&lt;",
            '>' => out += "&gt;",
            '&' => out += "&amp;",
            '"' => out += "&quot;",
            '\'' => out += "&#39;",
            c => out.push(c),
        }
    }
    out
}

/// Escaped text, with text between backquotes as code.
fn code(text: &str) -> String {
    let parts = text.split('`').enumerate();
    parts.map(|(i, part)| if i % 2 == 1 { format!("<code>{part}</code>") } else { part.to_owned() }).collect()
}

/// `text` on one line, escaped for Markdown.
fn escaped_markdown(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '\\' | '`' | '*' | '_' | '|' | '[' | ']' | '#' => out.extend(['\\', c]),
            '<' => out += "&lt;",
            '&' => out += "&amp;",
            c if c.is_control() => out.push(' '),
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_escaped() {
        let name = "<script>alert('x')</script> | `a` & \"b\"\n# c";
        let table = ReportTable { header: vec!["policy".to_owned()], rows: vec![vec![name.to_owned()]], numbers_from: 1 };
        let plot = ReportPlot { file: "a.svg".to_owned(), caption: name.to_owned(), svg: "<svg></svg>\n".to_owned() };
        let section = ReportSection { title: name.to_owned(), text: "t".to_owned(), table: Some(table), plots: vec![plot] };
        let document = ReportPage { title: "t".to_owned(), command: name.to_owned(), sections: vec![section] };
        let page = html(&document);
        assert!(!page.contains("<script") && page.contains("&lt;script&gt;"));
        assert!(page.contains("<svg></svg>") && !page.contains("http"));
        let text = markdown(&document);
        let (_, after_command) = text.split_once("```\n\n").expect("the command comes first");
        assert!(!after_command.contains("<script") && !after_command.contains("\n# c"));
        assert!(after_command.contains("![") && after_command.contains("(a.svg)"));
    }
}
