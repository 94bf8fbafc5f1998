//! Hosted environments over gRPC and REST: equality with `BatchEnv`, retries, automatic resets, limits.

use bytes::Bytes;
use futures::future::join_all;
use qedgix::api::convert::structs::to_struct;
use qedgix::env::{BatchEnv, EnvConfig, EpisodeMetrics};
use qedgix::train_config;
use qedgix::wire::v1;
use qedgix::wire::v1::environment_service_client::EnvironmentServiceClient;
use rand::RngExt;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use tonic::Code;
use tonic::transport::Channel;

use super::harness::*;
use super::rest::Rest;

type Client = EnvironmentServiceClient<Channel>;

async fn client(server: &Server) -> Client {
    EnvironmentServiceClient::new(server.channel().await)
}

fn create(id: &str, count: u32, environment: &Value) -> v1::CreateEnvironmentRequest {
    let (environment, environment_id) = (to_struct(environment), id.into());
    v1::CreateEnvironmentRequest { environment, count: Some(count), environment_id, seed: 7, auto_reset: false }
}

/// Creates an environment and returns its first state.
async fn create_and_reset(client: &mut Client, request: v1::CreateEnvironmentRequest) -> v1::EnvironmentState {
    let id = client.create_environment(request).await.unwrap().into_inner().environment_id;
    client.reset(reset(&id)).await.unwrap().into_inner()
}

fn reset(id: &str) -> v1::ResetRequest {
    v1::ResetRequest { environment_id: id.into(), ..Default::default() }
}

/// Random headings of step `step`, from a seed.
fn headings(count: usize, uavs: usize, of: u32, step: u64) -> Vec<v1::Headings> {
    let mut rng = qedgix::rng::stream(3, "test-headings", step);
    let mut copy = || (0..uavs).map(|_| rng.random_range(0..of)).collect();
    (0..count).map(|_| v1::Headings { headings: copy() }).collect()
}

fn step(id: &str, step: u64, actions: Vec<v1::Headings>) -> v1::StepRequest {
    v1::StepRequest { environment_id: id.into(), actions, step: Some(step), return_graph: false }
}

async fn step_once(client: &mut Client, request: v1::StepRequest) -> v1::EnvironmentState {
    client.step(request).await.unwrap().into_inner()
}

fn flat(actions: &[v1::Headings]) -> Vec<u8> {
    actions.iter().flat_map(|copy| &copy.headings).map(|&heading| heading as u8).collect()
}

fn wire_metrics(m: EpisodeMetrics) -> v1::EpisodeMetrics {
    m.into()
}

/// Checks that all numbers in `state` are bit-identical to those in `env`.
fn assert_same(state: &v1::EnvironmentState, env: &BatchEnv) {
    let scenes = || state.copies.iter().map(|copy| copy.scene.as_ref().unwrap());
    let bits = |xs: &[f32]| xs.iter().map(|&x| f64::from(x).to_bits()).collect::<Vec<_>>();
    let uavs: Vec<u64> = scenes().flat_map(|s| &s.uavs).flat_map(|u| [u.x.to_bits(), u.y.to_bits()]).collect();
    let users: Vec<u64> = scenes().flat_map(|s| &s.users).flat_map(|u| [u.x.to_bits(), u.y.to_bits()]).collect();
    let aoi: Vec<u64> = scenes().flat_map(|s| &s.users).map(|u| u.aoi.to_bits()).collect();
    let rewards: Vec<u32> = state.copies.iter().map(|copy| copy.reward.to_bits()).collect();
    assert_eq!((uavs, users), (bits(env.uav_xy()), bits(env.user_xy())));
    assert_eq!(aoi, bits(env.aoi()));
    assert_eq!(rewards, env.reward().iter().map(|r| r.to_bits()).collect::<Vec<_>>());
}

#[tokio::test]
async fn hosted_environment_is_bit_identical_to_batch_env() {
    let server = Server::start().await;
    let mut client = client(&server).await;
    let cases = [
        ("default", 1, json!({})),
        ("letters", 3, json!({"M": 2, "N": 4, "K": 11, "v": 0.1, "t": 0.2, "d": 0.3})),
        (
            "options",
            4,
            json!({"slots": 9, "hover": true, "boundary": "free", "start": "random", "user_speed": 0.05, "reward_scale": 5,
                   "weights": [1, 2, 3, 4, 0.5]}),
        ),
        ("large, on a blocking thread", 2, json!({"uavs": 40, "users": 700, "slots": 3})),
    ];
    for (id, count, environment) in cases {
        let config: EnvConfig = train_config::parse_environment(environment.clone()).unwrap();
        let mut env = BatchEnv::new(&config, count).unwrap();
        env.reset(&(0..count as u64).map(|b| 7 + b).collect::<Vec<_>>());
        let state = create_and_reset(&mut client, create(id, count as u32, &environment)).await;
        assert_eq!((state.step, state.episode, state.slot, state.copies.len()), (0, 0, 0, count));
        assert_same(&state, &env);
        for k in 0..config.slots as u64 {
            let actions = headings(count, config.uavs, config.actions() as u32, k);
            env.step(&flat(&actions));
            let state = step_once(&mut client, step(id, k, actions)).await;
            assert_eq!((state.step, state.slot), (k + 1, env.slot() as u32));
            assert_same(&state, &env);
            for (b, copy) in state.copies.into_iter().enumerate() {
                assert_eq!((copy.truncated, copy.seed), (env.done(), 7 + b as u64), "{id}, copy {b}");
                let metrics = copy.finished.map(|finished| finished.metrics.unwrap());
                assert_eq!(metrics, env.done().then(|| wire_metrics(env.metrics(b))), "{id}, copy {b}");
            }
        }
    }
}

#[tokio::test]
async fn repeated_step_returns_the_same_state() {
    let server = Server::start().await;
    let mut client = client(&server).await;
    let environment = json!({"slots": 4, "start": "random"});
    create_and_reset(&mut client, v1::CreateEnvironmentRequest { auto_reset: true, ..create("e", 2, &environment) }).await;
    let actions = |k| headings(2, 3, 8, k);
    assert_eq!(refused(client.step(step("e", 1, actions(1))).await).1, "wrong_step");
    for k in 0..6 {
        let attempts = (0..4).map(|_| {
            let mut client = client.clone();
            async move { step_once(&mut client, step("e", k, actions(k))).await }
        });
        let answers = with_timeout(join_all(attempts)).await;
        assert!(answers.iter().all(|answer| *answer == answers[0]), "step {k}");
        let other = step_once(&mut client, step("e", k, actions(k + 100))).await;
        assert_eq!(other, answers[0], "a repetition returns the first state, whatever its actions");
        assert_eq!((other.step, other.slot, other.episode), (k + 1, (k as u32 + 1) % 4, (k + 1) / 4));
        assert_eq!(other.copies[0].finished.is_some(), k == 3);
        for wrong in [k + 2, k.wrapping_sub(1), u64::MAX] {
            let (code, reason, message) = refused(client.step(step("e", wrong, actions(0))).await);
            assert_eq!((code, reason.as_str()), (Code::FailedPrecondition, "wrong_step"), "{message}");
        }
    }
    let without_step = v1::StepRequest { step: None, ..step("e", 0, actions(6)) };
    assert_eq!(step_once(&mut client, without_step).await.step, 7);
    let get = v1::GetEnvironmentRequest { environment_id: "e".into() };
    let shown = client.get_environment(get).await.unwrap().into_inner();
    assert_eq!((shown.step, shown.episode, shown.slot), (7, 1, 3));
}

#[tokio::test]
async fn automatic_reset_equals_a_reset_by_the_caller() {
    let server = Server::start().await;
    let mut client = client(&server).await;
    let environment = json!({"slots": 5, "user_speed": 0.02});
    create_and_reset(&mut client, v1::CreateEnvironmentRequest { auto_reset: true, ..create("auto", 3, &environment) }).await;
    create_and_reset(&mut client, create("by hand", 3, &environment)).await;
    let graph = |request: v1::StepRequest| v1::StepRequest { return_graph: true, ..request };
    for episode in 0..3 {
        for slot in 0..5 {
            let k = episode * 5 + slot;
            let auto = step_once(&mut client, graph(step("auto", k, headings(3, 3, 8, k)))).await;
            let by_hand = step_once(&mut client, graph(step("by hand", slot, headings(3, 3, 8, k)))).await;
            if slot < 4 {
                assert_eq!(auto.copies, by_hand.copies);
                continue;
            }
            let (code, reason, message) = refused(client.step(step("by hand", 5, headings(3, 3, 8, 0))).await);
            assert_eq!((code, reason.as_str()), (Code::FailedPrecondition, "episode_over"), "{message}");
            let next = v1::ResetRequest { return_graph: true, ..reset("by hand") };
            let next = client.reset(next).await.unwrap().into_inner();
            assert_eq!((auto.episode, auto.slot), (next.episode, next.slot));
            for ((auto, ended), next) in auto.copies.into_iter().zip(by_hand.copies).zip(next.copies) {
                assert!(auto.truncated && ended.truncated && !next.truncated);
                assert_eq!(
                    (auto.scene, auto.graph, auto.seed),
                    (next.scene, next.graph, next.seed),
                    "the observation is of the next episode"
                );
                assert_eq!((auto.reward, next.reward), (ended.reward, 0.0), "the reward is of the last step");
                let (finished, plain) = (auto.finished.unwrap(), ended.finished.unwrap());
                assert_eq!((finished.scene, finished.graph), (ended.scene, ended.graph), "the last observation of the episode");
                assert_eq!((finished.metrics, finished.seed), (plain.metrics, plain.seed));
                assert_eq!(plain.scene, None, "without automatic reset, the state itself is the last observation");
            }
        }
    }
}

#[tokio::test]
async fn reset_selects_the_episode_and_may_be_repeated() {
    let server = Server::start().await;
    let mut client = client(&server).await;
    let first = create_and_reset(&mut client, create("e", 2, &json!({"slots": 3}))).await;
    assert_eq!(client.reset(reset("e")).await.unwrap().into_inner(), first, "a reset at slot 0 changes nothing");
    step_once(&mut client, step("e", 0, headings(2, 3, 8, 0))).await;
    let second = client.reset(reset("e")).await.unwrap().into_inner();
    assert_eq!((second.episode, second.step, second.slot), (1, 0, 0));
    assert_eq!(client.reset(reset("e")).await.unwrap().into_inner(), second, "a repeated reset");
    assert_eq!(refused(client.step(step("e", 1, headings(2, 3, 8, 0))).await).1, "wrong_step", "steps count from the reset");
    let at = |seed, episode| v1::ResetRequest { seed, episode, ..reset("e") };
    let reset_to = async |request| client.clone().reset(request).await.unwrap().into_inner();
    assert_eq!(reset_to(at(None, Some(0))).await, first);
    assert_eq!(reset_to(at(None, Some(1))).await, second);
    assert_eq!(reset_to(at(Some(7), None)).await, first);
    assert_eq!(reset_to(at(Some(7), Some(1))).await, second);
    let other = reset_to(at(Some(8), None)).await;
    assert_eq!(other.copies[0], first.copies[1], "consecutive copies have consecutive seeds");
    assert_eq!(reset_to(at(Some(8), Some(1))).await.copies[0], second.copies[1], "in later episodes too");
    // The reported seed reproduces the episode.
    let seed = second.copies[1].seed;
    assert!(seed < 1 << 53, "exact in JSON");
    assert_eq!(reset_to(at(Some(seed), None)).await.copies[0].scene, second.copies[1].scene);
    assert_invalid(client.reset(at(Some(1 << 53), None)).await, "seed", "9007199254740992");
}

#[tokio::test]
async fn creating_twice_is_a_retry_only_with_equal_requests() {
    let server = Server::start().await;
    let mut client = client(&server).await;
    let good = || create("e", 2, &json!({"users": 4}));
    let first = client.create_environment(good()).await.unwrap().into_inner();
    assert_eq!((first.headings, first.count, first.seed), (8, 2, 7));
    let config = first.environment.as_ref().unwrap();
    assert_eq!(
        config.fields["reward_scale"].kind,
        Some(prost_types::value::Kind::NumberValue(1.0 / 80.0)),
        "the response has the complete configuration"
    );
    assert_eq!(client.create_environment(good()).await.unwrap().into_inner(), first);
    let different = [
        v1::CreateEnvironmentRequest { count: Some(3), ..good() },
        v1::CreateEnvironmentRequest { seed: 8, ..good() },
        v1::CreateEnvironmentRequest { auto_reset: true, ..good() },
        v1::CreateEnvironmentRequest { environment: None, ..good() },
    ];
    for different in different {
        let (code, reason, _) = refused(client.create_environment(different).await);
        assert_eq!((code, reason.as_str()), (Code::AlreadyExists, "already_exists"));
    }
    step_once(&mut client, step("e", 0, headings(2, 3, 8, 0))).await;
    assert_eq!(refused(client.create_environment(good()).await).0, Code::AlreadyExists);
    let unnamed = || v1::CreateEnvironmentRequest { environment_id: String::new(), ..good() };
    let generated = client.create_environment(unnamed()).await.unwrap().into_inner().environment_id;
    assert_ne!(client.create_environment(unnamed()).await.unwrap().into_inner().environment_id, generated);
}

#[tokio::test]
async fn observations_can_be_sent_to_act() {
    let server = Server::start().await;
    let (mut client, mut pilot) = (client(&server).await, server.grpc().await);
    for policy in ["sweep", "qedgix"] {
        let request = v1::CreateEnvironmentRequest { environment_id: policy.into(), ..create("", 2, &json!({"slots": 40})) };
        client.create_environment(request).await.unwrap();
        let with_graph = v1::ResetRequest { return_graph: true, ..reset(policy) };
        let mut state = client.reset(with_graph).await.unwrap().into_inner();
        let mut memory = [Bytes::new(), Bytes::new()];
        for k in 0..40 {
            let mut actions = Vec::new();
            for (copy, memory) in state.copies.iter().zip(&mut memory) {
                let by_scene = held(policy, memory.clone(), copy.scene.clone().unwrap());
                let observation = v1::act_request::Observation::Graph(copy.graph.clone().unwrap());
                let by_graph = v1::ActRequest { observation: Some(observation), ..by_scene.clone() };
                let by_scene = v1::ActRequest { step: Some(u64::from(state.slot)), ..by_scene };
                let answer = pilot.act(by_scene).await.unwrap().into_inner();
                assert_eq!(pilot.act(by_graph).await.unwrap().into_inner().actions, answer.actions, "{policy}, slot {k}");
                *memory = answer.recurrent_state;
                actions.push(v1::Headings { headings: answer.actions.iter().map(|a| a.heading_index).collect() });
            }
            let request = v1::StepRequest { return_graph: true, ..step(policy, k, actions) };
            state = step_once(&mut client, request).await;
        }
        let metrics = state.copies[0].finished.as_ref().unwrap().metrics.unwrap();
        assert!(metrics.coverage > 0.0 && metrics.mean_aoi < 40.0, "{metrics:?}");
    }
}

#[tokio::test]
async fn invalid_input_names_its_field() {
    let server = Server::start().await;
    let mut client = client(&server).await;
    let cases = [
        (json!({"uvas": 3}), "environment.uvas", ""),
        (json!({"uavs": "three"}), "environment.uavs", "\"three\""),
        (json!({"uavs": 2.5}), "environment.uavs", "2.5"),
        (json!({"M": 0}), "environment.uavs", "0"),
        (json!({"N": 3, "users": 3}), "environment.N", "3"),
        (json!({"lr": 3}), "environment.lr", ""),
        (json!({"d": 0.1}), "environment.detection_range", "0.1"),
        (json!({"start": {"given": [[0.1, 0.2]]}}), "environment.start.given", "1 positions"),
        (json!({"weights": [1, 2]}), "environment.weights", "2 values"),
        (json!({"users": 60_000}), "count", "1 copies of 60003"),
    ];
    for (environment, field, value) in cases {
        assert_invalid(client.create_environment(create("wrong", 1, &environment)).await, field, value);
    }
    let good = || create("e", 2, &json!({}));
    let wrong = [
        (v1::CreateEnvironmentRequest { count: Some(0), ..good() }, "count", "0"),
        (v1::CreateEnvironmentRequest { count: Some(1025), ..good() }, "count", "1025"),
        (v1::CreateEnvironmentRequest { seed: u64::MAX, ..good() }, "seed", "18446744073709551615"),
        (v1::CreateEnvironmentRequest { environment_id: "x".repeat(129), ..good() }, "environment_id", "\"xxx"),
    ];
    for (request, field, value) in wrong {
        assert_invalid(client.create_environment(request).await, field, value);
    }
    client.create_environment(good()).await.unwrap();
    let copy = |headings: &[u32]| v1::Headings { headings: headings.to_vec() };
    let wrong = [
        (vec![], "actions", "0 entries"),
        (vec![copy(&[0, 0, 0]); 3], "actions", "3 entries"),
        (vec![copy(&[0, 0, 0]), copy(&[0, 0])], "actions[1].headings", "2 heading indices"),
        (vec![copy(&[0, 0, 0]), copy(&[0, 8, 0])], "actions[1].headings[1]", "8"),
        (vec![copy(&[256, 0, 0]), copy(&[0, 0, 0])], "actions[0].headings[0]", "256"),
    ];
    for (actions, field, value) in wrong {
        assert_invalid(client.step(step("e", 0, actions)).await, field, value);
    }
    assert_eq!(step_once(&mut client, step("e", 0, headings(2, 3, 8, 0))).await.step, 1, "rejected requests change nothing");
}

#[tokio::test]
async fn idle_environment_expires_with_its_own_error() {
    let server = Server::with(|config| config.environment_ttl = std::time::Duration::from_secs(60)).await;
    let mut client = client(&server).await;
    client.create_environment(create("e", 1, &json!({}))).await.unwrap();
    server.advance(59);
    step_once(&mut client, step("e", 0, headings(1, 3, 8, 0))).await;
    server.advance(61);
    let named = v1::DeleteEnvironmentRequest { environment_id: "e".into() };
    for (code, reason, _) in [
        refused(client.step(step("e", 1, headings(1, 3, 8, 1))).await),
        refused(client.reset(reset("e")).await),
        refused(client.get_environment(v1::GetEnvironmentRequest { environment_id: "e".into() }).await),
        refused(client.delete_environment(named.clone()).await),
    ] {
        assert_eq!((code, reason.as_str()), (Code::FailedPrecondition, "environment_expired"));
    }
    assert_eq!(refused(client.reset(reset("never")).await).0, Code::NotFound);
    client.create_environment(create("e", 1, &json!({}))).await.unwrap();
    step_once(&mut client, step("e", 0, headings(1, 3, 8, 0))).await;
    assert_eq!(client.delete_environment(named).await.unwrap().into_inner().step, 1);
    assert_eq!(refused(client.reset(reset("e")).await).0, Code::NotFound);
    server.app.draining.begin();
    for refusal in [
        refused(client.create_environment(create("f", 1, &json!({}))).await),
        refused(client.reset(reset("e")).await),
        refused(client.step(step("e", 0, vec![])).await),
    ] {
        assert_eq!((refusal.0, refusal.1.as_str()), (Code::Unavailable, "draining"));
    }
}

#[tokio::test]
async fn number_and_memory_of_environments_are_bounded() {
    let server = Server::with(|config| (config.max_environments, config.environment_memory) = (2, 2 << 20)).await;
    let mut client = client(&server).await;
    let mut create_copies = async |id: &str, count| client.create_environment(create(id, count, &json!({}))).await;
    for id in ["a", "b"] {
        create_copies(id, 1).await.unwrap();
    }
    let (code, reason, _) = refused(create_copies("c", 1).await);
    assert_eq!((code, reason.as_str()), (Code::ResourceExhausted, "resource_exhausted"));
    server.advance(601);
    create_copies("c", 1000).await.unwrap();
    assert_eq!(refused(create_copies("d", 1000).await).0, Code::ResourceExhausted);
    create_copies("c", 1000).await.expect("a retry takes no memory");
    server.advance(601);
    create_copies("d", 1000).await.expect("expired environments free their memory");

    let large = Server::start().await;
    let mut client = self::client(&large).await;
    client.create_environment(create("e", 1, &json!({"uavs": 10, "users": 1000}))).await.unwrap();
    let with_graph = v1::ResetRequest { return_graph: true, ..reset("e") };
    assert_invalid(client.reset(with_graph).await, "return_graph", "true");
    assert_eq!(client.reset(reset("e")).await.unwrap().into_inner().copies[0].scene.as_ref().unwrap().users.len(), 1000);
}

#[tokio::test]
async fn rest_is_equivalent_to_grpc() {
    let server = Server::start().await;
    let (rest, mut client) = (Rest::new(&server), client(&server).await);
    let environment = json!({"K": 3, "uavs": 2.0});
    let body = json!({"environment": environment, "seed": 7, "count": 2, "auto_reset": true, "environment_id": "r/1"});
    let (status, shown) = rest.post("/v1/environments", &body).await;
    assert_eq!(
        (status, &shown["environment"]["slots"], &shown["headings"]),
        (StatusCode::CREATED, &json!(3), &json!(8)),
        "{shown}"
    );
    create_and_reset(&mut client, v1::CreateEnvironmentRequest { auto_reset: true, ..create("g", 2, &environment) }).await;
    for k in 0..4 {
        let actions = headings(2, 2, 8, k);
        let sent: Vec<Value> = actions.iter().map(|copy| json!({"headings": copy.headings})).collect();
        let body = json!({"actions": sent, "step": k, "return_graph": true});
        let (status, state) = rest.post("/v1/environments/r%2F1/step", &body).await;
        assert_eq!(status, StatusCode::OK, "{state}");
        let expected = step_once(&mut client, step("g", k, actions)).await;
        assert_eq!(
            (&state["step"], &state["slot"], &state["episode"]),
            (&json!(k + 1), &json!(expected.slot), &json!((k + 1) / 3))
        );
        for (a, b) in state["copies"].as_array().unwrap().iter().zip(&expected.copies) {
            assert_eq!((&a["truncated"], &a["seed"]), (&json!(b.truncated), &json!(b.seed)));
            assert_eq!(a["reward"].as_f64().unwrap() as f32, b.reward);
            for (user, expected) in a["scene"]["users"].as_array().unwrap().iter().zip(&b.scene.as_ref().unwrap().users) {
                assert_eq!(*user, json!({"id": expected.id, "x": expected.x, "y": expected.y, "aoi": expected.aoi}));
            }
            let mean = b.finished.as_ref().map(|finished| finished.metrics.unwrap().mean_aoi);
            assert_eq!(a["finished"]["metrics"]["mean_aoi"].as_f64(), mean);
            // Observations can be sent to Act unchanged.
            let by_scene = rest.post("/v1/act", &json!({"policy": "sweep", "scene": a["scene"]})).await.1;
            let by_graph = rest.post("/v1/act", &json!({"policy": "sweep", "graph": a["graph"]})).await.1;
            assert_eq!(by_scene["actions"].as_array().unwrap().len(), 2, "{by_scene}");
            assert_eq!(by_scene["actions"], by_graph["actions"]);
        }
    }
    let first = rest.post("/v1/environments/r%2F1/reset", &json!({"seed": 7})).await.1;
    assert_eq!((&first["episode"], &first["step"]), (&json!(0), &json!(0)));
    let listed = rest.get("/v1/environments?page_size=1").await.1;
    assert_eq!((&listed["environments"][0]["environment_id"], &listed["next_page_token"]), (&json!("g"), &json!("g")));
    assert_eq!(rest.get("/v1/environments?page_token=g").await.1["environments"][0]["count"], 2);
    let cases = [
        ("/v1/environments", json!({"environment": {"uvas": 1}}), 422, "invalid_schema"),
        ("/v1/environments", json!({"environment": {"uavs": 0}}), 400, "invalid_argument"),
        ("/v1/environments", json!({"environment": 3}), 422, "invalid_schema"),
        ("/v1/environments", json!({"environments": {}}), 422, "invalid_schema"),
        ("/v1/environments", json!({"count": 0}), 400, "invalid_argument"),
        ("/v1/environments", json!({"environment_id": "g"}), 409, "already_exists"),
        ("/v1/environments/g/reset", json!({"seeds": 3}), 422, "invalid_schema"),
        ("/v1/environments/g/step", json!({}), 422, "invalid_schema"),
        ("/v1/environments/g/step", json!({"actions": []}), 400, "invalid_argument"),
        ("/v1/environments/never/reset", json!({}), 404, "not_found"),
    ];
    for (path, body, status, code) in cases {
        let refused = rest.refused(path, &body.to_string()).await;
        assert_eq!((refused.0, refused.1.as_str()), (status, code), "{path} {body}: {}", refused.2);
    }
    assert_eq!(rest.send(Method::DELETE, "/v1/environments/g", "").await.0, StatusCode::OK);
    assert_eq!(rest.get("/v1/environments/g").await.0, StatusCode::NOT_FOUND);
    server.advance(601);
    assert_eq!(rest.refused("/v1/environments/r%2F1/reset", "{}").await.1, "environment_expired");
}
