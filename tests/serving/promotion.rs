//! Aliases: moved for all at once, compared and set, remembered; and what the server serves is what the database says,
//! whoever changes it together with whom and leaves when.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bytes::Bytes;
use qedgix::error_code::ErrorCode;
use qedgix::policy::FleetStep;
use qedgix::service::policies::{self, AliasChange};
use qedgix::service::{App, PageRequest};
use qedgix::serving::FleetInput;
use qedgix::store::{AliasHistoryEntry, AliasHistoryFilter};
use qedgix::wire::v1;
use rand::RngExt;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};

use super::harness::*;
use super::policies::numbered;
use super::published::publish;
use super::rest::Rest;

fn live(name: &str, expected: Option<u64>) -> AliasChange {
    AliasChange { name: name.into(), alias: "live".into(), expected, by: None }
}

#[tokio::test]
async fn an_alias_is_set_moved_and_deleted_and_that_is_remembered() {
    let mut server = Server::start().await;
    for seed in 1..=3 {
        publish(&server, "mine", &numbered(seed)).await;
    }
    let rest = Rest::new(&server);
    let path = "/v1/policies/mine/aliases/live";
    let put = async |version: u64, expected: Option<u64>| {
        let body = json!({"version": version, "expected": expected}).to_string();
        rest.send(Method::PUT, path, body).await
    };
    let moved = |version: u64, previous: Value| json!({"alias": "live", "version": version, "previous": previous});
    assert_eq!(put(1, Some(2)).await.1["code"], "alias_moved");
    assert_eq!(put(1, Some(0)).await, (StatusCode::CREATED, moved(1, json!(null))));
    assert_eq!(put(1, Some(0)).await.1["code"], "alias_moved");
    server.advance(5);
    assert_eq!(put(2, Some(1)).await, (StatusCode::OK, moved(2, json!(1))));
    assert_eq!(put(2, None).await, (StatusCode::OK, moved(2, json!(2))), "nothing happens");
    let (status, problem) = put(3, Some(1)).await;
    assert_eq!((status.as_u16(), &problem["code"]), (409, &json!("alias_moved")), "{problem}");
    let (status, problem) = put(9, None).await;
    assert_eq!((status.as_u16(), &problem["detail"]), (404, &json!("policy mine has no version 9")));
    let aliases = json!({"aliases": [{"alias": "live", "version": 2}], "next_page_token": ""});
    assert_eq!(rest.get("/v1/policies/mine/aliases").await.1, aliases);
    assert_eq!(rest.get("/v1/policies/mine@live").await.1["ref"]["version"], 2);
    assert_eq!(rest.send(Method::PUT, "/v1/policies/mine/aliases/old", r#"{"version": 1}"#).await.0, StatusCode::CREATED);
    assert_eq!(rest.send(Method::DELETE, &format!("{path}?expected=1"), "").await.1["code"], "alias_moved");
    assert_eq!(rest.send(Method::DELETE, &format!("{path}?expected=2"), "").await.0, StatusCode::NO_CONTENT);
    let (status, problem) = rest.send(Method::DELETE, path, "").await;
    assert_eq!((status.as_u16(), &problem["detail"]), (404, &json!("no alias \"mine@live\"")));
    assert_eq!(rest.get("/v1/policies/mine@live").await.0, StatusCode::NOT_FOUND);

    let row = |alias: &str, previous: Value, version: Value, at: &str| json!({"alias": alias, "previous": previous, "version": version, "at": at, "by": null});
    let (then, later) = ("1970-01-01T00:00:00Z", "1970-01-01T00:00:05Z");
    let all = [
        row("live", json!(2), json!(null), later),
        row("old", json!(null), json!(1), later),
        row("live", json!(1), json!(2), later),
        row("live", json!(null), json!(1), then),
    ];
    let history = "/v1/policies/mine/history";
    assert_eq!(rest.get(history).await.1, json!({"history": all, "next_page_token": ""}));
    let first = rest.get(&format!("{history}?page_size=3")).await.1;
    assert_eq!(first["history"], json!(all[..3]));
    let token = first["next_page_token"].as_str().unwrap();
    let second = rest.get(&format!("{history}?page_size=3&page_token={token}")).await.1;
    assert_eq!(second, json!({"history": all[3..], "next_page_token": ""}));
    assert_eq!(rest.get(&format!("{history}?alias=old")).await.1["history"], json!(all[1..2]));
    for (path, status) in [
        (format!("{history}?page_token=x"), 400),
        (format!("{history}?page_size=1001"), 400),
        ("/v1/policies/nobody/history".into(), 404),
        ("/v1/policies/nobody/aliases".into(), 404),
        ("/v1/policies/mine:1/aliases".into(), 400),
    ] {
        assert_eq!(rest.get(&path).await.0.as_u16(), status, "{path}");
    }
    for (path, body, status) in [
        ("/v1/policies/mine/aliases/a:b", r#"{"version": 1}"#, 400),
        ("/v1/policies/sweep/aliases/live", r#"{"version": 1}"#, 409),
        ("/v1/policies/nobody/aliases/live", r#"{"version": 1}"#, 404),
        ("/v1/policies/mine/aliases/live", r#"{"version": -1}"#, 422),
        ("/v1/policies/mine/aliases/live", r#"{"versoin": 1}"#, 422),
        ("/v1/policies/mine/aliases/live", r#"{"version": 18446744073709551615}"#, 404),
    ] {
        assert_eq!(rest.send(Method::PUT, path, body).await.0.as_u16(), status, "{path} {body}");
    }
    server.begin_stop();
    let server = with_timeout(server.restarted()).await;
    let rest = Rest::new(&server);
    assert_eq!(rest.get(history).await.1["history"], json!(all));
    assert_eq!(
        rest.get("/v1/policies/mine/aliases").await.1,
        json!({"aliases": [{"alias": "old", "version": 1}], "next_page_token": ""})
    );
}

#[tokio::test]
async fn aliases_of_a_policy_are_bounded() {
    let server = Server::start().await;
    publish(&server, "mine", &numbered(1)).await;
    let set = async |alias: usize| {
        let target = AliasChange { name: "mine".into(), alias: format!("a{alias}"), expected: None, by: Some("somebody".into()) };
        policies::set_alias(&server.app, target, 1).await
    };
    for alias in 0..100 {
        assert_eq!(set(alias).await.unwrap(), None);
    }
    assert_eq!(set(100).await.unwrap_err().invalid().map(|invalid| invalid.field.as_str()), Some("alias"));
    assert_eq!(set(99).await.unwrap(), Some(1));
    let newest = policies::history(&server.app, "mine", None, &PageRequest { size: 1, ..Default::default() })
        .await
        .unwrap()
        .items
        .remove(0);
    assert_eq!((newest.alias.as_str(), newest.by.as_deref()), ("a99", Some("somebody")));
}

/// Headings of version 1 and 2 in `SLOTS` slots of the same scenes from the same seed, as their policies fly them alone.
fn offline() -> [Vec<Vec<u8>>; 2] {
    [1, 2].map(|seed| {
        let policy = numbered(seed).policy();
        let policy: &dyn qedgix::policy::Policy = &policy;
        let mut memory = vec![0.0; policy.memory_len(3, 5)];
        policy.start(3, 5, 0, &mut memory);
        let flown = (0..SLOTS).map(|step| {
            let slot = FleetInput::try_from(scene(3, 5, step)).unwrap().into_fleet_graph(policy).unwrap();
            let mut headings = vec![0; 3];
            policy.act(&mut [FleetStep {
                env: policy.env(),
                graph: &slot,
                profile: None,
                step,
                memory: &mut memory,
                headings: &mut headings,
                q_values: None,
            }]);
            headings
        });
        flown.collect()
    })
}

const SLOTS: u64 = 12;

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn callers_of_an_alias_that_moves_get_one_version_each_and_no_error() {
    let server = Server::start().await;
    publish(&server, "mine", &numbered(1)).await;
    publish(&server, "mine", &numbered(2)).await;
    policies::set_alias(&server.app, live("mine", None), 1).await.unwrap();
    let expected = Arc::new(offline());
    assert_ne!(expected[0], expected[1], "the versions have to differ, or a mix would not show");
    let done = Arc::new(AtomicBool::new(false));
    let movers: Vec<_> = (0..2)
        .map(|mover| {
            let (app, done) = (server.app.clone(), done.clone());
            tokio::spawn(async move {
                let mut moves = 0_u64;
                while !done.load(Ordering::Relaxed) {
                    policies::set_alias(&app, live("mine", None), (moves + mover) % 2 + 1).await.unwrap();
                    moves += 1;
                }
                moves
            })
        })
        .collect();
    let mut callers = Vec::new();
    for caller in 0..12 {
        let (client, expected) = (server.grpc().await, expected.clone());
        callers.push(tokio::spawn(async move {
            let mut seen = BTreeMap::new();
            for episode in 0..10 {
                let session = (caller % 2 == 0).then(|| format!("s-{caller}-{episode}"));
                let version = episode_of(client.clone(), session, &expected).await;
                *seen.entry(version).or_insert(0) += 1;
            }
            seen
        }));
    }
    let mut seen: BTreeMap<u64, u64> = BTreeMap::new();
    for caller in callers {
        for (version, episodes) in with_timeout(caller).await.unwrap() {
            *seen.entry(version).or_default() += episodes;
        }
    }
    done.store(true, Ordering::Relaxed);
    for mover in movers {
        assert!(mover.await.unwrap() > 0);
    }
    assert_eq!(seen.values().sum::<u64>(), 120);
    same_as_the_store(&server.app, "mine").await;
}

/// Flies an episode through `mine@live`, in a session or with memory that the caller keeps; its version.
async fn episode_of(
    mut client: v1::policy_service_client::PolicyServiceClient<tonic::transport::Channel>,
    session: Option<String>,
    expected: &[Vec<Vec<u8>>; 2],
) -> u64 {
    if let Some(id) = &session {
        client.open_session(open("mine@live", id)).await.unwrap();
    }
    let (mut state, mut flown) = (Bytes::new(), None);
    for step in 0..SLOTS {
        let request = match &session {
            Some(id) => in_session(id, Some(step), scene(3, 5, step)),
            None => held("mine@live", std::mem::take(&mut state), scene(3, 5, step)),
        };
        let answer = client.act(v1::ActRequest { policy: "mine@live".into(), ..request }).await.unwrap().into_inner();
        let version = answer.policy.unwrap().version;
        assert_eq!(*flown.get_or_insert(version), version, "an episode changed its version");
        let headings: Vec<u8> = answer.actions.iter().map(|action| action.heading_index as u8).collect();
        assert_eq!(headings, expected[version as usize - 1][step as usize], "version {version}, step {step}");
        state = answer.recurrent_state;
    }
    flown.unwrap()
}

/// All moves of the aliases of `name`, oldest first.
async fn moves(app: &App, name: &str) -> Vec<AliasHistoryEntry> {
    let filter = AliasHistoryFilter { name, alias: None, before: None };
    let mut moves = app.store.alias_history(filter, 1_000_000).await.unwrap();
    moves.reverse();
    moves
}

/// Checks that the registry serves what the database says, and that the history leads there without a gap.
async fn same_as_the_store(app: &App, name: &str) {
    let served = app.registry.aliases(name).unwrap();
    let stored = app.store.policy_aliases().await.unwrap().into_iter().filter(|alias| alias.name == name);
    assert_eq!(served, stored.map(|alias| (alias.alias, alias.version)).collect());
    let mut now = BTreeMap::new();
    for m in moves(app, name).await {
        assert_eq!(now.remove(&m.alias), m.previous, "{m:?}");
        now.extend(m.version.map(|version| (m.alias, version)));
    }
    assert_eq!(served, now);
    let unloaded = app.store.unloaded_policies().await.unwrap().into_iter().filter(|(n, _)| n == name);
    let versions = app.registry.versions_of(name);
    let resting = versions.iter().filter(|v| !v.loaded).map(|v| (name.to_owned(), v.reference.version));
    assert_eq!(resting.collect::<Vec<_>>(), unloaded.collect::<Vec<_>>());
    let stored = app.store.policy_versions().await.unwrap().into_iter().filter(|v| v.name == name);
    assert_eq!(versions.iter().map(|v| v.reference.version).collect::<Vec<_>>(), stored.map(|v| v.version).collect::<Vec<_>>());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn changes_by_many_who_may_leave_keep_the_registry_and_the_database_alike() {
    let mut server = Server::start().await;
    for seed in 1..=3 {
        publish(&server, "mine", &numbered(seed)).await;
    }
    let callers = (0..8_u64).map(|caller| {
        let app = server.app.clone();
        tokio::spawn(async move {
            let mut rng = qedgix::rng::stream(caller, "test-changes", 0);
            for _ in 0..40 {
                let (kind, version): (u32, u64) = (rng.random_range(0..6), rng.random_range(1..4));
                let patience: u64 = rng.random_range(0..12);
                let alias = if version == 3 { "live" } else { "old" };
                let target = || AliasChange { alias: alias.into(), ..live("mine", None) };
                let spec = format!("mine:{version}");
                let change = async {
                    // Refusals are as good as changes here.
                    match kind {
                        0..=2 => drop(policies::set_alias(&app, target(), version).await),
                        3 => drop(policies::delete_alias(&app, target()).await),
                        4 => drop(policies::unload_policy(&app, &spec).await),
                        _ => drop(policies::load_policy(&app, &spec).await),
                    }
                };
                // Some callers leave at once, some while the change is being written, some stay.
                let leave = async {
                    match patience {
                        0 => {}
                        1..9 => tokio::time::sleep(Duration::from_micros(patience * 250)).await,
                        _ => std::future::pending().await,
                    }
                };
                tokio::select! {
                    () = change => {}
                    () = leave => {}
                }
            }
        })
    });
    for caller in callers.collect::<Vec<_>>() {
        with_timeout(caller).await.unwrap();
    }
    // What those who left have begun goes on without them; each change holds the registry.
    let settled = async {
        while Arc::strong_count(&server.app.registry) > 1 {
            tokio::task::yield_now().await;
        }
    };
    with_timeout(settled).await;
    same_as_the_store(&server.app, "mine").await;
    assert!(moves(&server.app, "mine").await.len() > 10);
    let before = policies::index(&server.app);
    let aliases = server.app.registry.aliases("mine").unwrap();
    server.begin_stop();
    let server = with_timeout(server.restarted()).await;
    assert_eq!((policies::index(&server.app), server.app.registry.aliases("mine").unwrap()), (before, aliases));
    same_as_the_store(&server.app, "mine").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn of_all_who_expect_the_same_one_moves_it() {
    let server = Server::start().await;
    for seed in 1..=2 {
        publish(&server, "mine", &numbered(seed)).await;
    }
    for round in 0..20_u64 {
        let (now, next) = if round == 0 { (0, 1) } else { (2 - round % 2, round % 2 + 1) };
        let callers = (0..8).map(|_| {
            let app = server.app.clone();
            tokio::spawn(async move { policies::set_alias(&app, live("mine", Some(now)), next).await })
        });
        let mut won = 0;
        for caller in callers.collect::<Vec<_>>() {
            match with_timeout(caller).await.unwrap() {
                Ok(previous) => {
                    assert_eq!(previous.unwrap_or(0), now);
                    won += 1;
                }
                Err(refused) => assert_eq!(refused.code(), ErrorCode::AliasMoved),
            }
        }
        assert_eq!((won, server.app.registry.aliases("mine").unwrap()["live"]), (1, next), "round {round}");
    }
    assert_eq!(moves(&server.app, "mine").await.len(), 20);
}

#[tokio::test]
async fn what_is_missing_is_looked_for_again_after_the_change_in_progress() {
    let server = Server::start().await;
    let spec = "qedgix@late".parse().unwrap();
    // A change has reached the database and not yet the registry.
    let change = server.app.registry.lock_changes().await;
    let mut asked = std::pin::pin!(policies::get(&server.app, &spec));
    assert!(futures::poll!(&mut asked).is_pending());
    server.app.registry.set_alias("qedgix", "late", 1);
    drop(change);
    assert_eq!(with_timeout(asked).await.unwrap().info.reference.version, 1);
    assert!(policies::get(&server.app, &"qedgix@later".parse().unwrap()).await.is_err());
}
