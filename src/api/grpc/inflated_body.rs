//! The body of a gRPC request with compressed messages: hands them over inflated.
//!
//! tonic inflates a message at once, whatever its size. Here it is inflated in steps, between which other tasks run, and each step
//! counts against the limit of a message and the budget of bytes in flight.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use bytes::{Buf, BufMut, Bytes, BytesMut};
use http_body::{Body, Frame};
use tonic::Status;

use super::request_body::{HEAD, RequestBody};
use crate::api::body::Exchange;
use crate::api::compression::{Encoding, Inflater};
use crate::service::Error;

/// A body whose messages are inflated.
pub(super) struct InflatedBody {
    body: RequestBody,
    exchange: Arc<Exchange>,
    encoding: Encoding,
    /// Maximum size of a message in bytes.
    limit: usize,
    /// What the body handed over and was not inflated yet.
    received: BytesMut,
    inflating: Option<Inflater>,
    /// Bytes of the last message, which are given back when the next one is wanted.
    handed_over: usize,
    failed: bool,
}

impl InflatedBody {
    /// Inflates the messages of `body`.
    pub(super) fn new(body: RequestBody, exchange: Arc<Exchange>, encoding: Encoding, limit: usize) -> Self {
        let (received, inflating) = Default::default();
        Self { body, exchange, encoding, limit, received, inflating, handed_over: 0, failed: false }
    }

    /// The next step of the current message: the message if it is complete.
    fn step(&mut self) -> Result<Option<Bytes>, Error> {
        let Some(inflater) = &mut self.inflating else { return Ok(None) };
        let bytes = inflater.step()?;
        self.exchange.holding.grow(bytes)?;
        self.handed_over += bytes;
        if bytes > 0 {
            return Ok(None);
        }
        let mut message = self.inflating.take().map(Inflater::finish).unwrap_or_default();
        // At most the limit, which fits into 4 bytes.
        let length = (message.len() - HEAD) as u32;
        message[1..HEAD].copy_from_slice(&length.to_be_bytes());
        Ok(Some(message.freeze()))
    }

    /// The next message of what was received, if it is complete: as it is, or, if it is compressed, in `inflating`.
    fn next(&mut self) -> Option<Bytes> {
        let [flag, length @ ..] = *self.received.first_chunk::<HEAD>()?;
        let end = HEAD + u32::from_be_bytes(length) as usize;
        if self.received.len() < end {
            return None;
        }
        let mut message = self.received.split_to(end).freeze();
        // An empty message has nothing to inflate.
        if flag == 0 {
            return Some(message);
        }
        message.advance(HEAD);
        self.inflating = Some(Inflater::new(self.encoding, message, &[0; HEAD], self.limit));
        None
    }
}

impl Body for InflatedBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let this = &mut *self;
        if this.failed {
            return Poll::Ready(None);
        }
        if this.inflating.is_none() {
            this.exchange.holding.shrink(std::mem::take(&mut this.handed_over));
        }
        loop {
            match this.step() {
                Ok(Some(message)) => return Poll::Ready(Some(Ok(Frame::data(message)))),
                Ok(None) if this.inflating.is_some() => {
                    // Others first.
                    context.waker().wake_by_ref();
                    return Poll::Pending;
                }
                Ok(None) => {}
                Err(error) => {
                    this.failed = true;
                    return Poll::Ready(Some(Err(error.into())));
                }
            }
            if let Some(message) = this.next() {
                return Poll::Ready(Some(Ok(Frame::data(message))));
            }
            if this.inflating.is_some() {
                continue;
            }
            match ready!(Pin::new(&mut this.body).poll_frame(context)) {
                Some(Ok(frame)) => this.received.put(frame.into_data().unwrap_or_default()),
                end => return Poll::Ready(end),
            }
        }
    }

    fn is_end_stream(&self) -> bool {
        self.failed || self.inflating.is_none() && self.received.is_empty() && self.body.is_end_stream()
    }
}
