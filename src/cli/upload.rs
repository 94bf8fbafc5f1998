//! The body of an upload: parts of a file, which move a progress bar as they are sent.

use std::convert::Infallible;
use std::pin::Pin;
use std::task::{Context, Poll};

use bytes::Bytes;
use http_body::{Body, Frame, SizeHint};
use indicatif::ProgressBar;

/// Size of a part.
const PART: usize = 64 << 10;

/// The bytes that are not sent yet.
pub(super) struct Upload {
    pub(super) bytes: Bytes,
    pub(super) bar: ProgressBar,
}

impl Body for Upload {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(mut self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        if self.bytes.is_empty() {
            return Poll::Ready(None);
        }
        let size = self.bytes.len().min(PART);
        let part = self.bytes.split_to(size);
        self.bar.inc(size as u64);
        Poll::Ready(Some(Ok(Frame::data(part))))
    }

    fn is_end_stream(&self) -> bool {
        self.bytes.is_empty()
    }

    fn size_hint(&self) -> SizeHint {
        SizeHint::with_exact(self.bytes.len() as u64)
    }
}

#[cfg(test)]
mod tests {
    use http_body_util::BodyExt;

    use super::*;

    #[tokio::test]
    async fn every_byte_is_sent_once_and_counted() {
        for size in [0, 1, PART, 3 * PART + 7] {
            let bytes: Vec<u8> = (0..size).map(|i| i as u8).collect();
            let bar = ProgressBar::hidden();
            let upload = Upload { bytes: bytes.clone().into(), bar: bar.clone() };
            assert_eq!(upload.size_hint().exact(), Some(size as u64));
            assert_eq!(upload.collect().await.unwrap().to_bytes(), bytes);
            assert_eq!(bar.position(), size as u64);
        }
    }
}
