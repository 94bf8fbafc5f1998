//! Progress bars on standard error, silent where it is no terminal.

use indicatif::{ProgressBar, ProgressStyle};

/// A bar of `length` units called `what`.
pub fn bar(length: u64, what: &'static str) -> ProgressBar {
    let style = ProgressStyle::with_template(&format!(
        "{{bar:32}} {{human_pos}}/{{human_len}} {what}  {{elapsed}} (left {{eta}})  {{msg}}"
    ))
    .expect("the template is valid");
    ProgressBar::new(length).with_style(style)
}

/// A spinner beside `what`, for work of unknown length.
pub fn spinner(what: &str) -> ProgressBar {
    let spinner = ProgressBar::new_spinner().with_message(what.to_owned());
    spinner.enable_steady_tick(std::time::Duration::from_millis(100));
    spinner
}
