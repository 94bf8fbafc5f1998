//! The limit of uploads of checkpoints, which are held in memory until they are published.

use std::time::Duration;

use reqwest::{Client, RequestBuilder, StatusCode};
use tokio::time::timeout;

use super::harness::*;
use super::policies::numbered;

#[tokio::test]
async fn upload_permits_are_held_until_checkpoints_are_published() {
    const TIMEOUT: Duration = Duration::from_secs(30);
    let server = Server::start().await;
    let body = numbered(1).to_bytes();
    let upload = |name: &str| -> RequestBuilder {
        let url = server.url(&format!("/v1/policies/{name}/versions"));
        Client::new().post(url).header("content-type", "application/octet-stream").body(body.clone())
    };
    // Publishing waits for this lock, so uploads are received and not published.
    let guard = server.app.registry.lock_changes().await;
    let mut uploads = Vec::new();
    for i in 0..4 {
        let request = upload(&format!("policy-{i}"));
        uploads.push(tokio::spawn(async move {
            loop {
                let answer = request.try_clone().expect("the body is in memory").send().await.unwrap();
                // The test itself holds a permit for a moment below.
                if answer.status() != StatusCode::TOO_MANY_REQUESTS {
                    return answer.status();
                }
            }
        }));
    }
    let all_held = async {
        while server.app.uploads.acquire().is_ok() {
            tokio::task::yield_now().await;
        }
    };
    timeout(TIMEOUT, all_held).await.expect("every upload takes a permit");
    let refused = async || {
        let answer = timeout(TIMEOUT, upload("one-more").send()).await.expect("refused without waiting for other uploads");
        assert_eq!(answer.unwrap().status(), StatusCode::TOO_MANY_REQUESTS);
    };
    for _ in 0..50 {
        refused().await;
    }
    // The checkpoint of a caller that disconnects stays in memory, and keeps its permit.
    uploads.pop().expect("four uploads").abort();
    for _ in 0..50 {
        refused().await;
    }
    drop(guard);
    for status in uploads {
        assert_eq!(status.await.unwrap(), StatusCode::CREATED);
    }
    let returned = async {
        while server.app.uploads.acquire().is_err() {
            tokio::task::yield_now().await;
        }
    };
    timeout(TIMEOUT, returned).await.expect("permits are returned");
}
