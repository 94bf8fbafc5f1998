//! Progress bars on standard error: one line each, with rate and time left. Without a terminal they are hidden, and commands print
//! plain lines. They have no colours.

use std::fmt;

use indicatif::{HumanCount, MultiProgress, ProgressBar, ProgressState, ProgressStyle};

/// A bar of `length` units.
pub fn bar(length: u64, unit: &'static str) -> ProgressBar {
    ProgressBar::new(length).with_style(style(unit))
}

/// A bar of `length` units below the others.
pub fn bar_among(bars: &MultiProgress, length: u64, unit: &'static str) -> ProgressBar {
    bars.add(ProgressBar::new(length)).with_style(style(unit))
}

/// A bar of `length` bytes.
pub fn bytes_bar(length: u64) -> ProgressBar {
    let template = "{bar:20} {percent:>3} %  {bytes} of {total_bytes}, {bytes_per_sec}, {eta} left  {wide_msg}";
    ProgressBar::new(length).with_style(ProgressStyle::with_template(template).expect("the template is valid"))
}

/// One line that fits the terminal, whatever its width: the message is cut.
fn style(unit: &str) -> ProgressStyle {
    let template =
        format!("{{bar:20}} {{percent:>3}} %  {{human_pos}} of {{human_len}} {unit}, {{rate}}, {{eta}} left  {{wide_msg}}");
    let style = ProgressStyle::with_template(&template).expect("the template is valid");
    style.with_key("rate", |state: &ProgressState, line: &mut dyn fmt::Write| {
        // There is nowhere to report a failure.
        let _ = write!(line, "{}/s", rate(state.per_sec()));
    })
}

/// Three digits of a rate: `0.123`, `12.3`, `1,234`.
fn rate(per_second: f64) -> String {
    match per_second {
        rate if !rate.is_finite() => "0".to_owned(),
        rate if rate >= 100.0 => HumanCount(rate as u64).to_string(),
        rate if rate >= 1.0 => format!("{rate:.1}"),
        rate => format!("{rate:.3}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_have_three_digits() {
        for (per_second, text) in [(0.0, "0.000"), (0.1234, "0.123"), (12.34, "12.3"), (1234.5, "1,234"), (f64::NAN, "0")] {
            assert_eq!(rate(per_second), text);
        }
    }
}
