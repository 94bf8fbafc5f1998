//! Many slots at once: `ActBatch`, `ActStream`, and the engine that puts fleets together.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures::StreamExt;
use qedgix::wire::v1;
use qedgix::wire::v1::act_result::Result as Told;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;

use super::harness::*;

fn answered(result: v1::ActResult) -> v1::ActResponse {
    match result.result {
        Some(Told::Response(response)) => response,
        other => panic!("{other:?} instead of an answer"),
    }
}

fn error(result: v1::ActResult) -> (i32, String) {
    match result.result {
        Some(Told::Error(error)) => (error.status, error.code),
        other => panic!("{other:?} instead of an error"),
    }
}

#[tokio::test]
async fn each_slot_of_a_batch_is_answered_or_refused_on_its_own() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    client.open_session(open("qedgix", "s")).await.unwrap();
    let mut nonsense = held("sweep", Bytes::new(), scene(3, 5, 1));
    nonsense.observation = None;
    let alone = client.act(held("qedgix", Bytes::new(), scene(3, 5, 2))).await.unwrap().into_inner();
    let requests = vec![
        in_session("s", Some(0), scene(3, 5, 1)),
        nonsense,
        held("qedgix", Bytes::new(), scene(3, 5, 2)),
        in_session("nobody", Some(0), scene(3, 5, 1)),
        held("sweep", Bytes::new(), scene(2, 9, 3)),
        in_session("s", Some(7), scene(3, 5, 1)),
    ];
    let results = client.act_batch(v1::ActBatchRequest { requests }).await.unwrap().into_inner().results;
    let [first, nonsense, same, nobody, sweep, ahead] = <[_; 6]>::try_from(results).unwrap();
    assert_eq!(answered(first).step, 0);
    assert_eq!(error(nonsense), (Code::InvalidArgument.into(), "invalid_argument".into()));
    let same = answered(same);
    assert_eq!((headings(&same), same.recurrent_state), (headings(&alone), alone.recurrent_state), "the bits of a call alone");
    assert_eq!(error(nobody), (Code::NotFound.into(), "not_found".into()));
    assert_eq!(answered(sweep).actions.len(), 2);
    assert_eq!(error(ahead), (Code::FailedPrecondition.into(), "wrong_step".into()));
    for wrong in [0, 1025] {
        let requests = vec![held("sweep", Bytes::new(), scene(1, 1, 1)); wrong];
        assert_invalid(client.act_batch(v1::ActBatchRequest { requests }).await, "requests", &wrong.to_string());
    }
}

#[tokio::test]
async fn a_stream_flies_episodes_and_outlives_refused_slots() {
    let mut server = Server::start().await;
    let mut client = server.grpc().await;
    for id in ["a", "b"] {
        client.open_session(open("qedgix", id)).await.unwrap();
        client.open_session(open("qedgix", &format!("{id}-alone"))).await.unwrap();
    }
    let (ask, asked) = mpsc::channel(8);
    let mut answers = client.act_stream(ReceiverStream::new(asked)).await.unwrap().into_inner();
    for step in 0..10 {
        for id in ["a", "b"] {
            ask.send(in_session(id, Some(step), scene(3, 5, step))).await.unwrap();
        }
        ask.send(in_session("a", Some(step + 5), scene(3, 5, step))).await.unwrap();
        for id in ["a", "b"] {
            let told = answered(soon(answers.next()).await.unwrap().unwrap());
            let alone = client.act(in_session(&format!("{id}-alone"), None, scene(3, 5, step))).await.unwrap().into_inner();
            assert_eq!((told.step, headings(&told)), (step, headings(&alone)), "session {id}");
        }
        let (status, code) = error(soon(answers.next()).await.unwrap().unwrap());
        assert_eq!((status, code.as_str()), (Code::FailedPrecondition.into(), "wrong_step"));
    }
    // A server that drains ends the stream when everything asked before is answered.
    server.begin_stop();
    while let Some(rest) = soon(answers.next()).await {
        assert!(rest.is_ok_and(|r| matches!(r.result, Some(Told::Error(_)))), "nothing was asked");
    }
    drop(ask);
    soon(server.stopped()).await;
}

#[tokio::test]
async fn fleets_that_wait_for_one_policy_fly_together_and_alone_alike() {
    let server = Server::with(|config| (config.engine.threads, config.engine.max_batch) = (1, 4)).await;
    let gate = Arc::new(Gate::default());
    server.add("slow", 1, Arc::new(Deed::Wait(gate.clone())));
    server.add("count", 1, Arc::new(Deed::Count));
    let client = server.grpc().await;
    let ask = |request: v1::ActRequest| {
        let mut client = client.clone();
        tokio::spawn(async move { client.act(request).await.unwrap().into_inner() })
    };
    let blocked = ask(held("slow", Bytes::new(), scene(1, 1, 0)));
    gate.reached(1).await;
    let learned: Vec<_> = (0..6).map(|seed| ask(held("qedgix", Bytes::new(), scene(3, 5, seed)))).collect();
    let other = ask(held("count", Bytes::new(), scene(2, 2, 0)));
    while server.app.engine.waiting() < 7 {
        tokio::task::yield_now().await;
    }
    gate.open();
    soon(blocked).await.unwrap();
    // All are waited for before one is asked alone, or it would fly with those that are left.
    let learned: Vec<_> = soon(futures::future::join_all(learned)).await.into_iter().map(Result::unwrap).collect();
    let mut sizes = Vec::new();
    for (seed, together) in learned.into_iter().enumerate() {
        let alone = client.clone().act(held("qedgix", Bytes::new(), scene(3, 5, seed as u64))).await.unwrap().into_inner();
        assert_eq!((headings(&together), &together.recurrent_state), (headings(&alone), &alone.recurrent_state));
        sizes.push(together.timings.unwrap().batch_size);
        assert_eq!(alone.timings.unwrap().batch_size, 1);
    }
    sizes.sort_unstable();
    assert_eq!(sizes, [2, 2, 4, 4, 4, 4], "at most four at a time, the rest after them");
    assert_eq!(soon(other).await.unwrap().timings.unwrap().batch_size, 1, "another policy flies apart");
}

#[tokio::test]
async fn a_fleet_that_may_wait_for_company_leaves_when_the_batch_is_full_or_time_is_up() {
    let delay = |config: &mut qedgix::config::Config, delay| {
        (config.engine.threads, config.engine.max_batch, config.engine.max_batch_delay) = (2, 2, delay);
    };
    // Nobody waits ten seconds: the second fleet fills the batch.
    let server = Server::with(|config| delay(config, Duration::from_secs(10))).await;
    let client = server.grpc().await;
    let ask = || {
        let mut client = client.clone();
        tokio::spawn(async move { client.act(held("sweep", Bytes::new(), scene(2, 2, 0))).await.unwrap().into_inner() })
    };
    let (one, two) = (ask(), ask());
    assert_eq!(soon(one).await.unwrap().timings.unwrap().batch_size, 2);
    assert_eq!(soon(two).await.unwrap().timings.unwrap().batch_size, 2);
    let server = Server::with(|config| delay(config, Duration::from_millis(1))).await;
    let alone = soon(async { server.grpc().await.act(held("sweep", Bytes::new(), scene(2, 2, 0))).await }).await.unwrap();
    assert_eq!(alone.into_inner().timings.unwrap().batch_size, 1);
}

#[tokio::test]
async fn sessions_are_shown_page_by_page() {
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
