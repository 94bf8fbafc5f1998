//! The body of a gRPC request. Hands a message over when it has arrived completely.
//!
//! tonic reserves the announced length of a message as soon as it sees the first 5 bytes. Here they wait until the message is
//! complete, so that memory follows the bytes that arrived. A message in one frame, such as a small `Act`, passes unchanged.

use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use bytes::{Bytes, BytesMut};
use http_body::{Body, Frame};
use tokio_util::sync::WaitForCancellationFutureOwned;
use tonic::Status;

use super::call::CallContext;
use crate::api::body::{BodyError, IncomingBody};
use crate::invalid::Invalid;
use crate::service::Error;

/// The body of a request. The body of a stream ends when the server closes, even if the client has not ended it, so that the
/// response ends, too.
pub(super) struct RequestBody {
    body: IncomingBody,
    context: Arc<CallContext>,
    method: usize,
    framing: Framing,
    /// The message that is incomplete.
    partial: Pieces,
    /// Complete messages.
    ready: VecDeque<Bytes>,
    messages: u64,
    ended: bool,
    /// Streams only.
    closing: Option<Pin<Box<WaitForCancellationFutureOwned>>>,
    /// Whether the time of a message runs.
    timed: bool,
    /// Bytes handed over in a stream that has one response, which are given back when the next message is wanted.
    handed_over: usize,
}

impl RequestBody {
    /// The body of a call of method number `method`. `compressed`: its messages may be compressed.
    pub(super) fn new(body: IncomingBody, context: Arc<CallContext>, method: usize, compressed: bool) -> Self {
        let is_stream = context.methods.get(method).streams.client;
        if is_stream {
            body.exchange().between_parts();
        }
        let closing = is_stream.then(|| Box::pin(context.closing.clone().cancelled_owned()));
        let framing = Framing { limit: context.methods.get(method).limit, compressed, ..Framing::default() };
        let (partial, ready) = Default::default();
        Self { body, context, method, framing, partial, ready, messages: 0, ended: false, closing, timed: false, handed_over: 0 }
    }

    /// Takes data that arrived, and returns data to hand over.
    fn take(&mut self, mut data: Bytes) -> Result<Option<Bytes>, Error> {
        self.body.exchange().holding.grow(data.len())?;
        let Scanned { complete, messages } = self.framing.scan(&data)?;
        if self.closing.is_some() {
            self.count(messages, if messages > 0 { self.partial.len() + complete } else { 0 });
        }
        if self.partial.is_empty() && complete == data.len() {
            return Ok(Some(data));
        }
        let rest = data.split_off(complete);
        if messages > 0 {
            self.ready.extend(self.partial.take());
            self.ready.push_back(data);
        }
        self.partial.push(rest);
        Ok(self.ready.pop_front())
    }

    /// Counts the complete messages of a stream, and starts the time of one that is incomplete.
    fn count(&mut self, messages: u64, bytes: usize) {
        let (exchange, method) = (self.body.exchange(), self.context.methods.get(self.method));
        if messages > 0 {
            method.metrics().received.increment(messages);
            self.messages += messages;
            if method.streams.server {
                exchange.until_answered(self.messages, bytes);
            } else {
                self.handed_over += bytes;
            }
            if self.timed {
                exchange.between_parts();
            }
        }
        let incomplete = self.framing.is_incomplete();
        if incomplete && (messages > 0 || !self.timed) {
            exchange.begin_part();
        }
        self.timed = incomplete;
    }

    fn fail(&mut self, error: impl Into<Status>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        self.ended = true;
        Poll::Ready(Some(Err(error.into())))
    }
}

impl Body for RequestBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let this = &mut *self;
        loop {
            if let Some(data) = this.ready.pop_front() {
                return Poll::Ready(Some(Ok(Frame::data(data))));
            }
            if this.ended {
                return Poll::Ready(None);
            }
            this.body.exchange().holding.shrink(std::mem::take(&mut this.handed_over));
            let frame = match Pin::new(&mut this.body).poll_frame(context) {
                Poll::Ready(frame) => frame,
                Poll::Pending => match &mut this.closing {
                    Some(closing) => return closing.as_mut().poll(context).map(|()| None),
                    None => return Poll::Pending,
                },
            };
            let data = match frame {
                Some(Ok(frame)) => frame.into_data().unwrap_or_default(),
                // The caller is gone, and the task of the call ends with it. A stream ends after what was received.
                Some(Err(BodyError::Broken(_))) if this.closing.is_none() => return Poll::Pending,
                Some(Err(BodyError::Broken(_))) => return this.fail(Status::cancelled("cancelled by the client")),
                Some(Err(BodyError::Exhausted(exhausted))) => return this.fail(Error::from(exhausted)),
                Some(Err(BodyError::TooSlow)) => return this.fail(incomplete(&BodyError::TooSlow)),
                None if this.framing.is_incomplete() => return this.fail(incomplete(&"the stream ended")),
                None => return Poll::Ready(None),
            };
            match this.take(data) {
                Ok(None) => {}
                Ok(Some(data)) => return Poll::Ready(Some(Ok(Frame::data(data)))),
                Err(error) => return this.fail(error),
            }
        }
    }

    fn is_end_stream(&self) -> bool {
        self.ready.is_empty() && (self.ended || self.body.is_end_stream() && !self.framing.is_incomplete())
    }
}

/// The error for a message of which a part is missing.
fn incomplete(reason: &dyn std::fmt::Display) -> Error {
    Invalid::new("message", format!("an incomplete message: {reason}"), "a complete message").into()
}

/// Length of the head of a message: a flag for compression, and the length of the message in 4 bytes.
pub(super) const HEAD: usize = 5;

/// Finds the borders of messages.
#[derive(Debug, Default)]
struct Framing {
    /// Maximum size of a message in bytes.
    limit: usize,
    /// Whether messages may be compressed.
    compressed: bool,
    head: [u8; HEAD],
    /// Bytes of the head that have arrived.
    have: usize,
    /// Bytes missing from the current message.
    rest: usize,
}

/// What a piece of the body contains.
struct Scanned {
    /// Length of the part that ends with the last complete message.
    complete: usize,
    /// Messages that end in the piece.
    messages: u64,
}

impl Framing {
    fn is_incomplete(&self) -> bool {
        self.have > 0 || self.rest > 0
    }

    fn scan(&mut self, data: &[u8]) -> Result<Scanned, Error> {
        let mut scanned = Scanned { complete: 0, messages: 0 };
        let mut at = 0;
        while at < data.len() {
            if self.rest == 0 {
                let part = &data[at..data.len().min(at + HEAD - self.have)];
                self.head[self.have..self.have + part.len()].copy_from_slice(part);
                self.have += part.len();
                at += part.len();
                if self.have < HEAD {
                    break;
                }
                (self.have, self.rest) = (0, self.announced()?);
            }
            let part = self.rest.min(data.len() - at);
            self.rest -= part;
            at += part;
            if self.rest == 0 {
                scanned = Scanned { complete: at, messages: scanned.messages + 1 };
            }
        }
        Ok(scanned)
    }

    /// The length that a complete head announces.
    fn announced(&self) -> Result<usize, Error> {
        let [flag, length @ ..] = self.head;
        match flag {
            0 => {}
            1 if self.compressed => {}
            1 => {
                let expected = "a message without compression (grpc-encoding: identity)";
                return Err(Error::MediaType(Invalid::new("message", "a compressed message", expected)));
            }
            _ => return Err(Invalid::new("message", format!("compression flag {flag}"), "a gRPC message").into()),
        }
        let length = u32::from_be_bytes(length) as usize;
        if length > self.limit {
            let message = format!("the message has {length} bytes, the limit is {}", self.limit);
            return Err(Error::TooLarge { message, limit: Some(self.limit as u64) });
        }
        Ok(length)
    }
}

/// Smaller pieces are copied together: a piece keeps the whole buffer that it was read into.
const SMALL_PIECE: usize = 8 << 10;
/// Size of such a copy.
const COPY: usize = 64 << 10;

/// Pieces of one message.
#[derive(Default)]
struct Pieces {
    whole: Vec<Bytes>,
    /// Small pieces after these.
    tail: BytesMut,
    len: usize,
}

impl Pieces {
    fn len(&self) -> usize {
        self.len
    }

    fn is_empty(&self) -> bool {
        self.len == 0
    }

    fn push(&mut self, piece: Bytes) {
        self.len += piece.len();
        if piece.len() >= SMALL_PIECE {
            self.end_tail();
            self.whole.push(piece);
        } else {
            self.tail.extend_from_slice(&piece);
            if self.tail.len() >= COPY {
                self.end_tail();
            }
        }
    }

    fn end_tail(&mut self) {
        if !self.tail.is_empty() {
            self.whole.push(self.tail.split().freeze());
        }
    }

    fn take(&mut self) -> Vec<Bytes> {
        self.end_tail();
        let Self { whole: pieces, .. } = std::mem::take(self);
        pieces
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(length: usize) -> Vec<u8> {
        let mut bytes = vec![0];
        bytes.extend((length as u32).to_be_bytes());
        bytes.extend((0..length).map(|i| i as u8));
        bytes
    }

    #[test]
    fn messages_are_found_for_any_split_of_the_body() {
        let body: Vec<u8> = [0, 3, 300, 0, 1].into_iter().flat_map(message).collect();
        for size in 1..=body.len() {
            let (mut framing, mut partial, mut out) =
                (Framing { limit: 300, ..Framing::default() }, Pieces::default(), Vec::new());
            let mut messages = 0;
            for piece in body.chunks(size) {
                let scanned = framing.scan(piece).unwrap();
                messages += scanned.messages;
                if scanned.messages > 0 {
                    out.extend(partial.take().concat());
                    out.extend(&piece[..scanned.complete]);
                }
                partial.push(Bytes::copy_from_slice(&piece[scanned.complete..]));
                assert_eq!(partial.is_empty(), !framing.is_incomplete());
            }
            assert_eq!((messages, &out), (5, &body), "in pieces of {size}");
        }
    }

    #[test]
    fn heads_are_refused_before_the_message_arrives() {
        let mut framing = Framing { limit: 300, ..Framing::default() };
        let error = framing.scan(&message(301)[..5]).err().unwrap();
        assert!(matches!(error, Error::TooLarge { limit: Some(300), .. }), "{error:?}");
        for (flag, unsupported) in [(1, true), (2, false)] {
            let error = Framing { limit: 300, ..Framing::default() }.scan(&[flag, 0, 0, 0, 1]).err().unwrap();
            assert_eq!(matches!(error, Error::MediaType(_)), unsupported, "{error:?}");
        }
    }

    #[test]
    fn small_pieces_are_copied_together() {
        let mut pieces = Pieces::default();
        for _ in 0..COPY {
            pieces.push(Bytes::from_static(b"xy"));
        }
        pieces.push(vec![0; SMALL_PIECE].into());
        assert_eq!(pieces.len(), 2 * COPY + SMALL_PIECE);
        assert_eq!(pieces.take().len(), 3);
        assert!(pieces.is_empty() && pieces.take().is_empty());
    }
}
