//! An error and its causes as one text, for logs and the command line.

use std::error::Error;
use std::iter;

/// The error, followed by its causes. A cause that the text already has is left out: some errors repeat their causes.
pub fn text(error: &(dyn Error + 'static)) -> String {
    let mut text = error.to_string();
    for cause in iter::successors(error.source(), |&cause| cause.source()) {
        let cause = cause.to_string();
        if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("{text}")]
    struct Layer {
        text: &'static str,
        source: Option<Box<Self>>,
    }

    #[test]
    fn every_cause_is_in_the_text_once() {
        let layer = |text, source| Layer { text, source };
        let inner = layer("the disk is gone", None);
        let repeated = layer("read failed: the disk is gone", Some(Box::new(inner)));
        let plain = layer("cannot start", Some(Box::new(repeated)));
        assert_eq!(
            text(&layer("internal error", Some(Box::new(plain)))),
            "internal error: cannot start: read failed: the disk is gone"
        );
    }
}
