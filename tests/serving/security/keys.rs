//! API keys: creation, expiry, revocation, rotation, and what the server stores of them.

use std::time::Duration;

use qedgix::error_code::ErrorCode;
use qedgix::service::keys;
use qedgix::wire::v1;
use tonic::Code;

use super::super::harness::*;
use super::{key, make, misspelled, refresh, signed};

/// Status and error code of `GET /v1/policies`.
async fn ask(server: &Server, key: &str) -> (u16, String) {
    let answer = reqwest::Client::new().get(server.url("/v1/policies")).bearer_auth(key).send().await.unwrap();
    let (status, body) = (answer.status().as_u16(), answer.json::<serde_json::Value>().await.unwrap());
    (status, body["code"].as_str().unwrap_or("").to_owned())
}

#[tokio::test]
async fn expired_and_revoked_keys_are_refused_and_keys_stay_required() {
    let server = Server::start().await;
    let forever = make(&server, "admin", |_| {}).await;
    let short = make(&server, "read", |new| new.lifetime = Some(Duration::from_secs(3600))).await;
    assert_eq!(ask(&server, &short.key).await.0, 200);
    server.advance(3599);
    assert_eq!(ask(&server, &short.key).await.0, 200);
    server.advance(1);
    assert_eq!(ask(&server, &short.key).await, (401, "unauthenticated".into()));
    keys::revoke(&server.app.store, &forever.info.id, server.app.clock.now()).await.unwrap();
    refresh(&server).await;
    assert_eq!(ask(&server, &forever.key).await, (401, "unauthenticated".into()));
    // No valid key is left, and requests still require one.
    assert_eq!(ask(&server, "").await, (401, "unauthenticated".into()));
    assert_eq!(reqwest::get(server.url("/v1/policies")).await.unwrap().status(), 401);
    let mut client = server.grpc().await;
    assert_eq!(refused(client.list_policies(v1::ListPoliciesRequest::default()).await).0, Code::Unauthenticated);
    // Deleting all rows under a running server revokes their keys and does not turn keys off.
    let last = key(&server, "read").await;
    assert_eq!(ask(&server, &last).await.0, 200);
    let database = format!("sqlite://{}", server.dir.path().join("qedgix.sqlite").display());
    let mut other = <sqlx::SqliteConnection as sqlx::Connection>::connect(&database).await.unwrap();
    sqlx::query("DELETE FROM api_keys").execute(&mut other).await.unwrap();
    refresh(&server).await;
    assert_eq!(reqwest::get(server.url("/v1/policies")).await.unwrap().status(), 401);
    assert_eq!(ask(&server, &last).await.0, 401);
}

#[tokio::test]
async fn malformed_keys_are_refused() {
    let server = Server::start().await;
    let (good, other) = (key(&server, "read").await, key(&server, "read").await);
    let (head, secret) = good.rsplit_once('_').unwrap();
    for wrong in [
        String::new(),
        secret.to_owned(),
        format!("{head}_"),
        format!("{good}x"),
        misspelled(&good),
        good.to_uppercase(),
        // The id of one key with the secret of another.
        format!("{head}_{}", other.rsplit_once('_').unwrap().1),
        format!("qdx_{}_{secret}", "0".repeat(10)),
        "x".repeat(10_000),
    ] {
        assert_eq!(ask(&server, &wrong).await.0, 401, "{wrong}");
    }
    assert_eq!(ask(&server, &good).await.0, 200);
}

#[tokio::test]
async fn a_running_server_notices_new_and_revoked_keys() {
    let server = Server::start().await;
    assert_eq!(ask(&server, "").await.0, 200, "no key is required while none exists");
    // A second connection to the database, as another process has it.
    let store = keys::open_store(server.dir.path(), keys::Purpose::Change).await.unwrap();
    let new =
        keys::NewKey { name: "k".into(), scopes: "read".parse().unwrap(), owner: None, lifetime: None, rate: None, burst: None };
    let created = keys::create(&store, new, server.app.clock.now()).await.unwrap();
    let until = async |status| {
        while ask(&server, &created.key).await.0 != status || ask(&server, "").await.0 != 401 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    with_timeout(until(200)).await;
    keys::revoke(&store, &created.key, server.app.clock.now()).await.unwrap();
    with_timeout(until(401)).await;
}

#[tokio::test]
async fn a_stream_ends_when_its_key_is_revoked() {
    let server = Server::start().await;
    let created = make(&server, "act", |_| {}).await;
    let mut client = server.grpc().await;
    let (sender, requests) = tokio::sync::mpsc::channel(1);
    let stream = tokio_stream::wrappers::ReceiverStream::new(requests);
    let mut answers = client.act_stream(signed(&created.key, stream)).await.unwrap().into_inner();
    let slot = || held("sweep", bytes::Bytes::new(), scene(2, 2, 0));
    sender.send(slot()).await.unwrap();
    let first = with_timeout(answers.message()).await.unwrap().unwrap();
    assert!(matches!(first.result, Some(v1::act_result::Result::Response(_))), "{first:?}");
    keys::revoke(&server.app.store, &created.info.id, server.app.clock.now()).await.unwrap();
    refresh(&server).await;
    sender.send(slot()).await.unwrap();
    let status = with_timeout(answers.message()).await.unwrap_err();
    assert_eq!((status.code(), status.message()), (Code::Unauthenticated, "the API key is revoked"));
}

#[tokio::test]
async fn rotation_copies_a_key_and_lets_the_old_one_expire() {
    let server = Server::start().await;
    let change = |new: &mut keys::NewKey| (new.lifetime, new.rate) = (Some(Duration::from_secs(1000)), Some(50.0));
    let old = make(&server, "read", change).await;
    server.advance(400);
    let (store, now) = (&server.app.store, server.app.clock.now());
    let new = keys::rotate(store, &old.key, Duration::from_secs(60), now).await.unwrap();
    assert_ne!(new.info.id, old.info.id);
    assert_eq!((new.info.scopes, new.info.rate, &new.info.name), (old.info.scopes, Some(50.0), &old.info.name));
    assert_eq!(new.info.expires_at.unwrap().duration_since(now).as_secs(), 1000);
    refresh(&server).await;
    assert_eq!([ask(&server, &old.key).await.0, ask(&server, &new.key).await.0], [200, 200]);
    server.advance(60);
    assert_eq!([ask(&server, &old.key).await.0, ask(&server, &new.key).await.0], [401, 200]);
    // A longer grace does not extend the old key, and an expired key cannot be rotated.
    let again = keys::rotate(store, &new.info.id, Duration::from_secs(1_000_000), server.app.clock.now()).await.unwrap();
    let list = keys::list(store, server.app.clock.now()).await.unwrap();
    let ends: Vec<_> = list.iter().map(|key| (key.id.as_str(), key.state, key.expires_at)).collect();
    assert!(ends.contains(&(&new.info.id, "active", new.info.expires_at)), "{ends:?}");
    assert!(ends.contains(&(&old.info.id, "expired", Some(now + Duration::from_secs(60)))), "{ends:?}");
    assert_eq!(again.info.name, old.info.name);
    let over = keys::rotate(store, &old.info.id, Duration::ZERO, server.app.clock.now()).await;
    assert_eq!(over.err().unwrap().code(), ErrorCode::WrongState);
    assert_eq!(keys::revoke(store, "nobody", now).await.err().unwrap().code(), ErrorCode::NotFound);
}

#[tokio::test]
async fn a_rotation_that_fails_leaves_no_new_key() {
    let server = Server::start().await;
    let old = make(&server, "read", |_| {}).await;
    let (store, now) = (&server.app.store, server.app.clock.now());
    let database = format!("sqlite://{}", server.dir.path().join("qedgix.sqlite").display());
    let mut other = <sqlx::SqliteConnection as sqlx::Connection>::connect(&database).await.unwrap();
    let full = "CREATE TRIGGER full BEFORE UPDATE OF expires_at ON api_keys BEGIN SELECT RAISE(ABORT, 'disk full'); END";
    sqlx::query(full).execute(&mut other).await.unwrap();
    assert_eq!(keys::rotate(store, &old.key, Duration::ZERO, now).await.err().unwrap().code(), ErrorCode::Internal);
    let list = keys::list(store, now).await.unwrap();
    assert_eq!(list.iter().map(|key| (&key.id, key.state)).collect::<Vec<_>>(), [(&old.info.id, "active")]);
    // A key that was revoked after it was read is not replaced either.
    sqlx::query("DROP TRIGGER full").execute(&mut other).await.unwrap();
    let record = store.keys().await.unwrap().remove(0);
    keys::revoke(store, &old.key, now).await.unwrap();
    let new = qedgix::store::KeyRecord { id: "another".into(), ..record };
    assert!(!store.rotate_key(&old.info.id, &new, now).await.unwrap());
    assert_eq!(store.keys().await.unwrap().len(), 1);
}

#[tokio::test]
async fn properties_of_new_keys_are_validated() {
    let server = Server::start().await;
    let refused = async |change: fn(&mut keys::NewKey)| {
        let mut new = keys::NewKey {
            name: "k".into(),
            scopes: "read".parse().unwrap(),
            owner: None,
            lifetime: None,
            rate: None,
            burst: None,
        };
        change(&mut new);
        match keys::create(&server.app.store, new, server.app.clock.now()).await {
            Err(qedgix::service::Error::Invalid(error)) => error.field,
            Err(other) => panic!("{other}"),
            Ok(_) => panic!("this has to be refused"),
        }
    };
    assert_eq!(refused(|new| new.name = String::new()).await, "name");
    assert_eq!(refused(|new| new.name = "x".repeat(129)).await, "name");
    assert_eq!(refused(|new| new.name = "a\nb".into()).await, "name");
    assert_eq!(refused(|new| new.rate = Some(f64::NAN)).await, "rate");
    assert_eq!(refused(|new| new.burst = Some(0.0)).await, "burst");
    assert_eq!(refused(|new| new.lifetime = Some(Duration::from_secs(u64::MAX / 4))).await, "expires");
    assert_eq!(reqwest::get(server.url("/v1/policies")).await.unwrap().status(), 200, "no key was created");
}

#[tokio::test]
async fn the_time_of_last_use_survives_a_restart() {
    let mut server = Server::start().await;
    let created = make(&server, "read", |_| {}).await;
    server.advance(5000);
    assert_eq!(ask(&server, &created.key).await.0, 200);
    let used = async |server: &Server| keys::list(&server.app.store, server.app.clock.now()).await.unwrap()[0].last_used_at;
    assert_eq!(used(&server).await, None, "requests do not write to the database");
    server.app.keys.save_last_used(&server.app.store).await.unwrap();
    assert_eq!(used(&server).await, Some(server.app.clock.now()));
    server.advance(5);
    assert_eq!(ask(&server, &created.key).await.0, 200);
    let last = server.app.clock.now();
    server.begin_stop();
    let server = server.restarted().await;
    assert_eq!(used(&server).await, Some(last), "saved at shutdown");
    assert_eq!(reqwest::get(server.url("/v1/policies")).await.unwrap().status(), 401);
    assert_eq!(ask(&server, &created.key).await.0, 200);
}

#[tokio::test]
async fn the_database_contains_no_secret() {
    let server = Server::start().await;
    let created = make(&server, "read", |new| new.name = "findable".into()).await;
    assert_eq!(ask(&server, &created.key).await.0, 200);
    let secret = created.key.rsplit_once('_').unwrap().1;
    let mut bytes = Vec::new();
    for file in std::fs::read_dir(server.dir.path()).unwrap() {
        bytes.extend(std::fs::read(file.unwrap().path()).unwrap());
    }
    let found = |text: &[u8]| bytes.windows(text.len()).any(|window| window == text);
    assert!(found(b"findable") && found(created.info.id.as_bytes()), "the database contains the key");
    assert!(found(&<sha2::Sha256 as sha2::Digest>::digest(secret)), "the database contains the digest");
    for part in secret.as_bytes().chunks_exact(12) {
        assert!(!found(part));
    }
}

#[tokio::test]
async fn the_history_of_an_alias_names_the_key() {
    let server = Server::start().await;
    let created = make(&server, "admin", |_| {}).await;
    let send = |request: reqwest::RequestBuilder| request.bearer_auth(&created.key).send();
    let client = reqwest::Client::new();
    let put = client.put(server.url("/v1/policies/qedgix/aliases/live")).header("content-type", "application/json");
    assert_eq!(send(put.body(r#"{"version": 1}"#)).await.unwrap().status(), 201);
    let history = send(client.get(server.url("/v1/policies/qedgix/history"))).await.unwrap().text().await.unwrap();
    assert!(history.contains(&format!("\"by\":\"{}\"", created.info.id)), "{history}");
}

#[tokio::test]
async fn job_event_streams_end_when_their_key_is_revoked() {
    use std::os::unix::fs::PermissionsExt;
    // A worker that does nothing, so the job runs until it is cancelled.
    let dir = tempfile::tempdir().unwrap();
    let idle = dir.path().join("idle");
    std::fs::write(&idle, "#!/bin/sh\nexec sleep 1000\n").unwrap();
    std::fs::set_permissions(&idle, std::fs::Permissions::from_mode(0o755)).unwrap();
    let server = Server::with(|config| config.worker = Some(idle)).await;
    let owner = make(&server, "jobs", |_| {}).await;
    let reader = make(&server, "read", |new| new.owner = Some(owner.info.owner.clone())).await;
    let owner = owner.key;
    let client = reqwest::Client::new();
    let post = async |path: &str, body: &'static str| {
        let request = client.post(server.url(path)).bearer_auth(&owner).header("content-type", "application/json").body(body);
        request.send().await.unwrap().json::<serde_json::Value>().await.unwrap()
    };
    let id = post("/v1/jobs", "{\"algorithm\": \"vdn\"}").await["id"].as_str().unwrap().to_owned();
    let mut jobs = v1::job_service_client::JobServiceClient::new(server.channel().await);
    let mut events =
        jobs.watch_job(signed(&reader.key, v1::WatchJobRequest { id: id.clone(), after: 0 })).await.unwrap().into_inner();
    let url = server.url(&format!("/v1/jobs/{id}/events"));
    let mut page = client.get(url).bearer_auth(&reader.key).send().await.unwrap();
    assert!(with_timeout(events.message()).await.unwrap().is_some());
    assert!(with_timeout(page.chunk()).await.unwrap().is_some());
    keys::revoke(&server.app.store, &reader.key, server.app.clock.now()).await.unwrap();
    refresh(&server).await;
    post(&format!("/v1/jobs/{id}/cancel"), "").await;
    let status = with_timeout(async {
        loop {
            // The worker ignores the cancellation: time passes until the server kills it. Longer steps would be pauses of the server.
            server.advance(5);
            if let Ok(Err(status)) = tokio::time::timeout(Duration::from_millis(50), events.message()).await {
                return status;
            }
        }
    });
    assert_eq!(status.await.code(), Code::Unauthenticated);
    let mut received = String::new();
    while let Some(part) = with_timeout(page.chunk()).await.unwrap() {
        received += std::str::from_utf8(&part).unwrap();
    }
    assert!(!received.contains("cancelled"), "{received}");
}
