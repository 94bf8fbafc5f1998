//! Progress bars on standard error, silent where it is no terminal.

use indicatif::{MultiProgress, ProgressBar, ProgressStyle};

/// A bar of `length` units called `what`.
pub fn bar(length: u64, what: &'static str) -> ProgressBar {
    ProgressBar::new(length).with_style(style(what))
}

/// A bar among others, drawn below those that are there.
pub fn bar_among(bars: &MultiProgress, length: u64, what: &'static str) -> ProgressBar {
    bars.add(ProgressBar::new(length)).with_style(style(what))
}

fn style(what: &str) -> ProgressStyle {
    let template = format!("{{bar:32}} {{human_pos}}/{{human_len}} {what}  {{elapsed}} (left {{eta}})  {{msg}}");
    ProgressStyle::with_template(&template).expect("the template is valid")
}

/// A spinner beside `what`, for work of unknown length.
pub fn spinner(what: &str) -> ProgressBar {
    let spinner = ProgressBar::new_spinner().with_message(what.to_owned());
    spinner.enable_steady_tick(std::time::Duration::from_millis(100));
    spinner
}
