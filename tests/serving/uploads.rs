//! The limit of uploads holds until their checkpoints are published.

use std::time::Duration;

use reqwest::{Client, RequestBuilder, StatusCode};
use tokio::time::timeout;

use super::harness::*;
use super::policies::numbered;

#[tokio::test]
async fn permits_are_held_until_checkpoints_are_published() {
    let server = Server::start().await;
    let body = numbered(1).to_bytes();
    let upload = |name: &str| -> RequestBuilder {
        let url = server.url(&format!("/v1/policies/{name}/versions"));
        Client::new().post(url).header("content-type", "application/octet-stream").body(body.clone())
    };
    // Publishing waits for its turn, so the uploads are read and not published.
    let guard = server.app.registry.lock_changes().await;
    let mut uploads = Vec::new();
    for i in 0..4 {
        uploads.push(tokio::spawn(upload(&format!("policy-{i}")).send()));
    }
    let refused = async {
        let mut in_a_row = 0;
        while in_a_row < 50 {
            match timeout(Duration::from_millis(100), upload("one-more").send()).await {
                Ok(answer) if answer.as_ref().unwrap().status() == StatusCode::TOO_MANY_REQUESTS => in_a_row += 1,
                // The other uploads have not begun yet; or they hold no permits.
                _ => in_a_row = 0,
            }
        }
    };
    timeout(Duration::from_secs(20), refused).await.expect("waiting uploads hold their permits");
    // A caller that disconnects leaves its checkpoint in memory, and so its permit.
    uploads.pop().unwrap().abort();
    assert_eq!(upload("one-more").send().await.unwrap().status(), StatusCode::TOO_MANY_REQUESTS);
    drop(guard);
    for answer in uploads {
        assert_eq!(answer.await.unwrap().unwrap().status(), StatusCode::CREATED);
    }
    let published = async { while upload("one-more").send().await.unwrap().status() == StatusCode::TOO_MANY_REQUESTS {} };
    timeout(Duration::from_secs(20), published).await.expect("permits are given back");
}
