//! Many slots at once: `ActBatch`, `ActStream`, and batches of the engine.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::StreamExt;
use qedgix::wire::v1;
use qedgix::wire::v1::act_result::Result as SlotResult;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;

use super::harness::*;

fn answered(result: v1::ActResult) -> v1::ActResponse {
    match result.result {
        Some(SlotResult::Response(response)) => response,
        other => panic!("{other:?} instead of an answer"),
    }
}

fn error(result: v1::ActResult) -> (i32, String) {
    match result.result {
        Some(SlotResult::Error(error)) => (error.status, error.code),
        other => panic!("{other:?} instead of an error"),
    }
}

#[tokio::test]
async fn slots_of_a_batch_succeed_or_fail_independently() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    client.open_session(open("qedgix", "s")).await.unwrap();
    let mut empty = held("sweep", Bytes::new(), scene(3, 5, 1));
    empty.observation = None;
    let single = client.act(held("qedgix", Bytes::new(), scene(3, 5, 2))).await.unwrap().into_inner();
    let requests = vec![
        in_session("s", Some(0), scene(3, 5, 1)),
        empty,
        held("qedgix", Bytes::new(), scene(3, 5, 2)),
        in_session("nobody", Some(0), scene(3, 5, 1)),
        held("sweep", Bytes::new(), scene(2, 9, 3)),
        in_session("s", Some(7), scene(3, 5, 1)),
    ];
    let results = client.act_batch(v1::ActBatchRequest { requests }).await.unwrap().into_inner().results;
    let [first, empty, same, nobody, sweep, ahead] = <[_; 6]>::try_from(results).unwrap();
    assert_eq!(answered(first).step, 0);
    assert_eq!(error(empty), (Code::InvalidArgument.into(), "invalid_argument".into()));
    let same = answered(same);
    assert_eq!(
        (headings(&same), same.recurrent_state),
        (headings(&single), single.recurrent_state),
        "bit-identical to a single call"
    );
    assert_eq!(error(nobody), (Code::NotFound.into(), "not_found".into()));
    assert_eq!(answered(sweep).actions.len(), 2);
    assert_eq!(error(ahead), (Code::FailedPrecondition.into(), "wrong_step".into()));
    for wrong in [0, 1025] {
        let requests = vec![held("sweep", Bytes::new(), scene(1, 1, 1)); wrong];
        assert_invalid(client.act_batch(v1::ActBatchRequest { requests }).await, "requests", &wrong.to_string());
    }
}

#[tokio::test]
async fn stream_continues_after_rejected_slots() {
    let mut server = Server::start().await;
    let mut client = server.grpc().await;
    for id in ["a", "b"] {
        client.open_session(open("qedgix", id)).await.unwrap();
        client.open_session(open("qedgix", &format!("{id}-single"))).await.unwrap();
    }
    let (requests, receiver) = mpsc::channel(8);
    let mut answers = client.act_stream(ReceiverStream::new(receiver)).await.unwrap().into_inner();
    for step in 0..10 {
        for id in ["a", "b"] {
            requests.send(in_session(id, Some(step), scene(3, 5, step))).await.unwrap();
        }
        requests.send(in_session("a", Some(step + 5), scene(3, 5, step))).await.unwrap();
        for id in ["a", "b"] {
            let streamed = answered(with_timeout(answers.next()).await.unwrap().unwrap());
            let single = client.act(in_session(&format!("{id}-single"), None, scene(3, 5, step))).await.unwrap().into_inner();
            assert_eq!((streamed.step, headings(&streamed)), (step, headings(&single)), "session {id}");
        }
        let (status, code) = error(with_timeout(answers.next()).await.unwrap().unwrap());
        assert_eq!((status, code.as_str()), (Code::FailedPrecondition.into(), "wrong_step"));
    }
    // A draining server ends the stream after it has answered all earlier requests.
    server.begin_stop();
    while let Some(rest) = with_timeout(answers.next()).await {
        assert!(rest.is_ok_and(|r| matches!(r.result, Some(SlotResult::Error(_)))), "only errors can follow");
    }
    drop(requests);
    with_timeout(server.stopped()).await;
}

#[tokio::test]
async fn batched_fleets_get_the_decisions_of_single_calls() {
    let server = Server::with(|config| (config.engine.threads, config.engine.max_batch) = (1, 4)).await;
    let gate = Arc::new(Gate::default());
    server.add("slow", 1, Arc::new(TestPolicy::Wait(gate.clone())));
    server.add("count", 1, Arc::new(TestPolicy::Count));
    let client = server.grpc().await;
    let send = |request: v1::ActRequest| {
        let mut client = client.clone();
        tokio::spawn(async move { client.act(request).await.unwrap().into_inner() })
    };
    let blocked = send(held("slow", Bytes::new(), scene(1, 1, 0)));
    gate.reached(1).await;
    let learned: Vec<_> = (0..6).map(|seed| send(held("qedgix", Bytes::new(), scene(3, 5, seed)))).collect();
    let other = send(held("count", Bytes::new(), scene(2, 2, 0)));
    while server.app.engine.waiting() < 7 {
        tokio::task::yield_now().await;
    }
    gate.open();
    with_timeout(blocked).await.unwrap();
    // Waits for all of them, so that the single calls below do not join a batch.
    let learned: Vec<_> = with_timeout(futures::future::join_all(learned)).await.into_iter().map(Result::unwrap).collect();
    let mut sizes = Vec::new();
    for (seed, batched) in learned.into_iter().enumerate() {
        let single = client.clone().act(held("qedgix", Bytes::new(), scene(3, 5, seed as u64))).await.unwrap().into_inner();
        assert_eq!((headings(&batched), &batched.recurrent_state), (headings(&single), &single.recurrent_state));
        sizes.push(batched.timings.unwrap().batch_size);
        assert_eq!(single.timings.unwrap().batch_size, 1);
    }
    sizes.sort_unstable();
    assert_eq!(sizes, [2, 2, 4, 4, 4, 4], "at most four fleets per batch");
    assert_eq!(with_timeout(other).await.unwrap().timings.unwrap().batch_size, 1, "another policy has a batch of its own");
}

#[tokio::test]
async fn batch_with_delay_starts_when_it_is_full_or_the_delay_has_passed() {
    let delay = |config: &mut qedgix::config::Config, delay| {
        (config.engine.threads, config.engine.max_batch, config.engine.max_batch_delay) = (2, 2, delay);
    };
    // The second fleet fills the batch, so the delay of ten seconds does not apply.
    let server = Server::with(|config| delay(config, Duration::from_secs(10))).await;
    let client = server.grpc().await;
    let send = || {
        let mut client = client.clone();
        tokio::spawn(async move { client.act(held("sweep", Bytes::new(), scene(2, 2, 0))).await.unwrap().into_inner() })
    };
    let (one, two) = (send(), send());
    assert_eq!(with_timeout(one).await.unwrap().timings.unwrap().batch_size, 2);
    assert_eq!(with_timeout(two).await.unwrap().timings.unwrap().batch_size, 2);
    let server = Server::with(|config| delay(config, Duration::from_millis(1))).await;
    let single =
        with_timeout(async { server.grpc().await.act(held("sweep", Bytes::new(), scene(2, 2, 0))).await }).await.unwrap();
    assert_eq!(single.into_inner().timings.unwrap().batch_size, 1);
}

#[tokio::test]
async fn sessions_are_listed_in_pages() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    for id in ["c", "a", "b"] {
        client.open_session(open("sweep", id)).await.unwrap();
    }
    client.act(in_session("b", Some(0), scene(2, 2, 0))).await.unwrap();
    let shown = client.get_session(v1::GetSessionRequest { session_id: "b".into() }).await.unwrap().into_inner();
    assert_eq!((shown.session_id.as_str(), shown.steps), ("b", 1));
    let page = |page_token: String| v1::ListSessionsRequest { page_size: 2, page_token };
    let first = client.list_sessions(page(String::new())).await.unwrap().into_inner();
    let second = client.list_sessions(page(first.next_page_token)).await.unwrap().into_inner();
    let names: Vec<_> = first.sessions.iter().chain(&second.sessions).map(|s| s.session_id.as_str()).collect();
    assert_eq!(names, ["a", "b", "c"]);
    assert_eq!(second.next_page_token, "");
    client.close_session(v1::CloseSessionRequest { session_id: "b".into() }).await.unwrap();
    let (code, ..) = refused(client.get_session(v1::GetSessionRequest { session_id: "b".into() }).await);
    assert_eq!(code, Code::NotFound);
}
