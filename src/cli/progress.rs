//! Progress bars on standard error, hidden if that is not a terminal.

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};

/// A bar of `length` units.
pub fn bar(length: u64, unit: &'static str) -> ProgressBar {
    ProgressBar::new(length).with_style(style(unit))
}

/// A bar of `length` units below the others.
pub fn bar_among(bars: &MultiProgress, length: u64, unit: &'static str) -> ProgressBar {
    bars.add(ProgressBar::new(length)).with_style(style(unit))
}

fn style(unit: &str) -> ProgressStyle {
    let template = format!("{{bar:32}} {{human_pos}}/{{human_len}} {unit}  {{elapsed}} (left {{eta}})  {{msg}}");
    ProgressStyle::with_template(&template).expect("the template is valid")
}

/// A spinner with a message, for work of unknown length.
pub fn spinner(message: &str) -> ProgressBar {
    let spinner = ProgressBar::new_spinner().with_message(message.to_owned());
    spinner.enable_steady_tick(std::time::Duration::from_millis(100));
    spinner
}
