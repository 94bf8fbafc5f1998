//! Callers that do not wait for responses are slowed down and not cut off.

use std::future::poll_fn;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use qedgix::wire::v1;

use super::*;

/// Messages that are sent before the first is answered: more small frames than HTTP/2 permits to wait.
const BEFORE: usize = 12_000;
const MESSAGES: usize = 40_000;

#[tokio::test]
async fn a_stream_of_many_small_messages_waits_for_the_policy() {
    let server = Server::start().await;
    let gate = Arc::new(Gate::default());
    server.add("waits", 1, Arc::new(TestPolicy::Wait(gate.clone())));
    let mut raw = Raw::connect(&server).await;
    let (response, mut stream) = raw.call(ACT_STREAM).await;
    let sent = Arc::new(AtomicUsize::new(0));
    let counter = sent.clone();
    let writer = tokio::spawn(async move {
        for number in 0..MESSAGES {
            // Only the first waits at the gate; the others are errors, which cost nothing.
            let message = if number == 0 {
                framed(&held("waits", Bytes::new(), scene(1, 1, 0)))
            } else {
                framed(&v1::ActRequest::default())
            };
            stream.reserve_capacity(message.len());
            while stream.capacity() < message.len() {
                poll_fn(|context| stream.poll_capacity(context)).await.expect("an open stream").expect("no error");
            }
            stream.send_data(message, number + 1 == MESSAGES).unwrap();
            counter.fetch_add(1, Ordering::Relaxed);
            // Every message is written on its own, as a caller without buffers does.
            tokio::task::yield_now().await;
        }
    });
    gate.reached(1).await;
    with_timeout(async {
        while sent.load(Ordering::Relaxed) < BEFORE {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    })
    .await;
    gate.open();
    let (status, data) = complete(response).await;
    assert_eq!(status.code(), Code::Ok, "{status:?}");
    with_timeout(writer).await.unwrap();
    let (mut answers, mut at) = (0, 0);
    while at < data.len() {
        at += 5 + u32::from_be_bytes(data[at + 1..at + 5].try_into().unwrap()) as usize;
        answers += 1;
    }
    assert_eq!(answers, MESSAGES);
    // The connection continues.
    assert_eq!(raw.unary(ACT, framed(&slot())).await.0.code(), Code::Ok);
}
