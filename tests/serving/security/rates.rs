//! Rate limits per API key, on both transports and for the slots of batches and streams.

use bytes::Bytes;
use qedgix::wire::v1;
use tonic::Code;
use tonic_types::StatusExt;
use v1::act_result::Result as ActResult;

use super::super::harness::*;
use super::{key, make, signed};

fn slot() -> v1::ActRequest {
    held("sweep", Bytes::new(), scene(2, 2, 0))
}

async fn rest(server: &Server, key: &str) -> (u16, Option<String>) {
    let answer = reqwest::Client::new().get(server.url("/v1/policies")).bearer_auth(key).send().await.unwrap();
    let retry = answer.headers().get("retry-after").map(|value| value.to_str().unwrap().to_owned());
    (answer.status().as_u16(), retry)
}

#[tokio::test]
async fn a_key_over_its_rate_is_refused_and_other_keys_are_not() {
    let server = Server::start().await;
    let slow = make(&server, "read,act", |new| (new.rate, new.burst) = (Some(0.5), Some(3.0))).await.key;
    let free = key(&server, "read,act").await;
    let mut client = server.grpc().await;
    assert_eq!(rest(&server, &slow).await.0, 200);
    assert_eq!(rest(&server, &slow).await.0, 200);
    client.act(signed(&slow, slot())).await.unwrap();
    assert_eq!(rest(&server, &slow).await, (429, Some("2".into())));
    let status = client.act(signed(&slow, slot())).await.unwrap_err();
    assert_eq!(status.code(), Code::ResourceExhausted);
    assert_eq!(status.metadata().get("retry-after").unwrap(), "2");
    assert_eq!(status.metadata().get("qedgix-code").unwrap(), "resource_exhausted");
    assert_eq!(status.get_error_details().retry_info().unwrap().retry_delay, Some(std::time::Duration::from_secs(2)));
    assert_eq!(rest(&server, &free).await.0, 200);
    server.advance(1);
    assert_eq!(rest(&server, &slow).await, (429, Some("1".into())));
    server.advance(1);
    assert_eq!(rest(&server, &slow).await.0, 200);
    assert_eq!(rest(&server, &slow).await.0, 429);
}

#[tokio::test]
async fn requests_without_the_scope_count_against_the_rate() {
    let server = Server::start().await;
    let slow = make(&server, "act", |new| (new.rate, new.burst) = (Some(0.5), Some(2.0))).await.key;
    let mut client = server.grpc().await;
    let mut list = async || client.list_policies(signed(&slow, v1::ListPoliciesRequest::default())).await.unwrap_err().code();
    assert_eq!(rest(&server, &slow).await.0, 403);
    assert_eq!(list().await, Code::PermissionDenied);
    assert_eq!(rest(&server, &slow).await, (429, Some("2".into())));
    assert_eq!(list().await, Code::ResourceExhausted);
    server.advance(2);
    assert_eq!(rest(&server, &slow).await.0, 403);
}

#[tokio::test]
async fn keys_without_a_rate_use_the_rate_of_the_server() {
    let server = Server::with(|config| (config.key_rate, config.key_burst) = (Some(1.0), Some(2.0))).await;
    let (usual, own) = (key(&server, "read").await, make(&server, "read", |new| new.rate = Some(100.0)).await.key);
    let all = async |key: &str| {
        let mut statuses = Vec::new();
        for _ in 0..4 {
            statuses.push(rest(&server, key).await.0);
        }
        statuses
    };
    assert_eq!(all(&usual).await, [200, 200, 429, 429]);
    assert_eq!(all(&own).await, [200; 4]);
}

#[tokio::test]
async fn slots_of_batches_and_streams_are_counted() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    let limited = async || make(&server, "act", |new| (new.rate, new.burst) = (Some(1.0), Some(3.0))).await.key;
    // A batch is answered as a whole, and later requests wait for its slots.
    let batch = limited().await;
    let answer = client.act_batch(signed(&batch, v1::ActBatchRequest { requests: vec![slot(); 6] })).await.unwrap();
    assert!(answer.into_inner().results.iter().all(|result| matches!(result.result, Some(ActResult::Response(_)))));
    assert_eq!(client.act(signed(&batch, slot())).await.unwrap_err().metadata().get("retry-after").unwrap(), "4");
    server.advance(4);
    client.act(signed(&batch, slot())).await.unwrap();

    // Opening a stream counts as one request, and each slot as another. Slots over the rate are refused individually.
    let stream = limited().await;
    let slots = tokio_stream::iter(vec![slot(); 4]);
    let mut answers = client.act_stream(signed(&stream, slots)).await.unwrap().into_inner();
    let mut codes = Vec::new();
    while let Some(answer) = with_timeout(answers.message()).await.unwrap() {
        codes.push(match answer.result.unwrap() {
            ActResult::Response(_) => Code::Ok,
            ActResult::Error(error) => Code::from(error.status),
        });
    }
    assert_eq!(codes, [Code::Ok, Code::Ok, Code::ResourceExhausted, Code::ResourceExhausted]);
}
