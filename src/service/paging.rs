//! Pages of lists: the size and the token of a page, the same for every list of both transports.

use std::io;

use serde::Serialize;

use crate::invalid::{Invalid, in_range};

/// A page of items whose sizes differ ends before it exceeds this many bytes; its first item may be larger.
pub(super) const MAX_BYTES: usize = 1 << 20;

/// The page of a list to return.
#[derive(Clone, Debug, Default)]
pub struct PageRequest {
    /// Maximum number of items; 0: the default of the list.
    pub size: u32,
    /// The token that the previous page returned; empty: the first page.
    pub token: String,
}

/// One page of a list.
#[derive(Clone, Debug, PartialEq)]
pub struct Page<T> {
    /// The items.
    pub items: Vec<T>,
    /// Token of the next page; empty on the last page.
    pub next_token: String,
}

impl PageRequest {
    /// The number of items, `default` unless the request sets one.
    pub(super) fn limit(&self, default: u32, max: u32) -> Result<usize, Invalid> {
        in_range("page_size", self.size, 0..=max)?;
        Ok(if self.size == 0 { default } else { self.size } as usize)
    }

    /// The number of items of a list whose pages have 100 items by default and 1000 at most.
    pub(super) fn usual_limit(&self) -> Result<usize, Invalid> {
        self.limit(100, 1000)
    }

    /// Parses the token with `parse`. Returns `None` for the first page.
    ///
    /// # Errors
    /// [`Invalid`] if `parse` rejects the token.
    pub(super) fn parse_token<T>(&self, parse: impl FnOnce(&str) -> Option<T>) -> Result<Option<T>, Invalid> {
        let invalid = || Invalid::new("page_token", format!("{:?}", self.token), "the next_page_token of the previous page");
        if self.token.is_empty() { Ok(None) } else { parse(&self.token).ok_or_else(invalid).map(Some) }
    }
}

impl<T> Page<T> {
    /// A page of `items`. `more`: whether the list continues after them. `token` returns the token of the page after an item.
    pub(super) fn new(items: Vec<T>, more: bool, token: impl Fn(&T) -> String) -> Self {
        let next_token = items.last().filter(|_| more).map(token).unwrap_or_default();
        Self { items, next_token }
    }

    /// As [`Page::new`], for items whose sizes differ: the page ends before it exceeds [`MAX_BYTES`].
    pub(super) fn bounded(mut items: Vec<T>, more: bool, bytes: impl Fn(&T) -> usize, token: impl Fn(&T) -> String) -> Self {
        let mut total = 0;
        let excess = items.iter().position(|item| {
            total += bytes(item);
            total > MAX_BYTES
        });
        let kept = excess.map_or(items.len(), |at| at.max(1));
        let more = more || kept < items.len();
        items.truncate(kept);
        Self::new(items, more, token)
    }

    /// The page with every item converted.
    pub fn map<U>(self, convert: impl FnMut(T) -> U) -> Page<U> {
        Page { items: self.items.into_iter().map(convert).collect(), next_token: self.next_token }
    }
}

/// Parses a row id, or another number of digits alone.
pub(super) fn parse_number(text: &str) -> Option<i64> {
    let digits = text.bytes().all(|b| b.is_ascii_digit());
    text.parse().ok().filter(|_| digits)
}

/// Bytes of `document` as JSON.
pub(super) fn json_bytes(document: &impl Serialize) -> usize {
    struct Counter(usize);

    impl io::Write for Counter {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0 += bytes.len();
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    let mut counter = Counter(0);
    // The counter never fails. A document that cannot be serialized cannot be sent either.
    let _ = serde_json::to_writer(&mut counter, document);
    counter.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_ends_before_it_is_too_large_and_has_at_least_one_item() {
        let page = |sizes: &[usize], more| Page::bounded(sizes.to_vec(), more, |&size| size, usize::to_string);
        assert_eq!(page(&[1, 2, 3], false), Page { items: vec![1, 2, 3], next_token: String::new() });
        assert_eq!(page(&[1, 2, 3], true).next_token, "3");
        assert_eq!(
            page(&[1, MAX_BYTES - 1, 3], false),
            Page { items: vec![1, MAX_BYTES - 1], next_token: (MAX_BYTES - 1).to_string() }
        );
        assert_eq!(page(&[MAX_BYTES + 1, 2], false).items, [MAX_BYTES + 1]);
        assert_eq!(page(&[MAX_BYTES + 1], false).next_token, "");
    }

    #[test]
    fn json_is_counted_as_it_is_written() {
        let document = serde_json::json!({"a": [1.5, "ü", null]});
        assert_eq!(json_bytes(&document), document.to_string().len());
    }
}
