//! What clients send in streams.

use std::future::ready;
use std::sync::Arc;

use futures::stream::{Stream, StreamExt};
use tonic::{Status, Streaming};

use super::call::in_line;
use crate::service::App;

/// The messages of a stream until the server drains: what was asked before is answered, then the stream ends, so that it does
/// not hold up the end. After a message that does not decode, or a caller that left, nothing more is read: the transport
/// would tell of the same error for ever.
pub(super) fn requests<T: Send + 'static>(app: Arc<App>, messages: Streaming<T>) -> impl Stream<Item = Result<T, Status>> {
    let until_drained = messages.take_until(async move { app.draining.wait().await });
    until_drained.scan(false, |over, message| {
        let last = std::mem::replace(over, message.is_err());
        let message = message.map_err(|status| in_line(&status).unwrap_or(status));
        ready((!last).then_some(message))
    })
}
