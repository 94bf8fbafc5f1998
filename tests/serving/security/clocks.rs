//! Wall time decides about what is stored, monotonic time about idle times and rates.

use std::time::Duration;

use reqwest::{Client, StatusCode};

use super::super::harness::*;
use super::make;

async fn status(server: &Server, path: &str, key: &str) -> StatusCode {
    Client::new().get(server.url(path)).bearer_auth(key).send().await.unwrap().status()
}

#[tokio::test]
async fn a_corrected_wall_time_expires_keys_but_neither_refills_rates_nor_expires_sessions() {
    let server = Server::start().await;
    let short = make(&server, "read", |new| new.lifetime = Some(Duration::from_secs(3600))).await.key;
    let slow = make(&server, "read", |new| (new.rate, new.burst) = (Some(0.5), Some(1.0))).await.key;
    let all = make(&server, "admin", |_| {}).await.key;
    let open = Client::new().post(server.url("/v1/sessions")).bearer_auth(&all).json(&serde_json::json!({
        "policy": "sweep", "session_id": "s",
    }));
    assert!(open.send().await.unwrap().status().is_success());
    assert_eq!(status(&server, "/v1/policies", &slow).await, StatusCode::OK);
    assert_eq!(status(&server, "/v1/policies", &slow).await, StatusCode::TOO_MANY_REQUESTS);
    let start = server.app.clock.now();
    server.time.set_wall(start + Duration::from_secs(3599));
    assert_eq!(status(&server, "/v1/policies", &slow).await, StatusCode::TOO_MANY_REQUESTS);
    assert_eq!(status(&server, "/v1/sessions/s", &all).await, StatusCode::OK);
    assert_eq!(status(&server, "/v1/policies", &short).await, StatusCode::OK);
    server.time.set_wall(start + Duration::from_secs(3600));
    assert_eq!(status(&server, "/v1/policies", &short).await, StatusCode::UNAUTHORIZED);
    // Set back, the wall time neither blocks rates nor keeps sessions.
    server.time.set_wall(start);
    server.advance(2);
    assert_eq!(status(&server, "/v1/policies", &slow).await, StatusCode::OK);
    server.advance(600);
    assert_eq!(status(&server, "/v1/sessions/s", &all).await, StatusCode::CONFLICT);
}
