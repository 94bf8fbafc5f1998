//! Published checkpoints: versions, restarts, what is refused, and learned policies flown like all others.

use bytes::Bytes;
use qedgix::checkpoint::{Checkpoint, parameter_layout};
use qedgix::policy::FleetStep;
use qedgix::service::Error;
use qedgix::service::policies::{self, Publisher};
use qedgix::serving::{FleetInput, PolicyRef};
use qedgix::train_config::{Algorithm, Preset, TrainConfig, Training};
use qedgix::wire::v1;
use rand::RngExt;
use sqlx::Connection;
use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};

use super::harness::*;

/// A checkpoint with weights drawn from `seed`.
pub fn checkpoint(algorithm: Algorithm, preset: Preset, seed: u64) -> Checkpoint {
    checkpoint_with(algorithm, preset, seed, |_| {})
}

/// A checkpoint with weights drawn from `seed` and a changed configuration.
pub fn checkpoint_with(algorithm: Algorithm, preset: Preset, seed: u64, change: impl FnOnce(&mut Training)) -> Checkpoint {
    let mut config = TrainConfig::preset(algorithm, preset);
    change(&mut config.training);
    config.environment.reward_scale = Some(1.0);
    let mut rng = qedgix::rng::stream(seed, "test-weights", 0);
    let weights = (0..parameter_layout(&config).len()).map(|_| rng.random_range(-0.3..0.3_f32)).collect();
    Checkpoint::new(config, 1234, None, weights).unwrap()
}

pub async fn publish(server: &Server, name: &str, checkpoint: &Checkpoint) -> PolicyRef {
    policies::publish_bytes(&server.app, Publisher::default(), name, checkpoint.to_bytes()).await.unwrap()
}

#[tokio::test]
async fn versions_count_up_and_equal_bytes_are_one_version() {
    let server = Server::start().await;
    let (a, b) = (checkpoint(Algorithm::Qmix, Preset::Practical, 1), checkpoint(Algorithm::Qmix, Preset::Practical, 2));
    let first = publish(&server, "mine", &a).await;
    assert_eq!((first.name.as_str(), first.version), ("mine", 1));
    assert_eq!(first.digest_hex(), qedgix::checkpoint::digest(&a.to_bytes()));
    assert_eq!(publish(&server, "mine", &b).await.version, 2);
    assert_eq!(publish(&server, "mine", &a).await, first);
    assert_eq!(publish(&server, "other", &a).await.version, 1);
    let mut client = server.grpc().await;
    let policy = client.get_policy(v1::GetPolicyRequest { policy: "mine".into() }).await.unwrap().into_inner();
    assert_eq!((policy.r#ref.as_ref().unwrap().version, policy.versions.as_slice()), (2, &[1, 2][..]));
    assert_eq!((policy.kind(), policy.uavs, policy.users), (v1::PolicyKind::Checkpoint, None, None));
    let config = policy.config.unwrap().fields;
    assert!(matches!(&config["algorithm"].kind, Some(prost_types::value::Kind::StringValue(name)) if name == "qmix"));
    assert!(matches!(policy.metrics.unwrap().fields["step"].kind, Some(prost_types::value::Kind::NumberValue(1234.0))));
}

#[tokio::test]
async fn what_was_published_is_served_after_a_restart() {
    let mut server = Server::start().await;
    let mine = checkpoint(Algorithm::Qedgix, Preset::Practical, 1);
    let reference = publish(&server, "mine", &mine).await;
    let target = policies::AliasChange { name: "mine".into(), alias: "prod".into(), expected: None, by: None };
    policies::set_alias(&server.app, target, 1).await.unwrap();
    let mut client = server.grpc().await;
    let before = client.act(held("mine", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner();
    server.begin_stop();
    let server = with_timeout(server.restarted()).await;
    let mut client = server.grpc().await;
    let after = client.act(held("mine@prod", Bytes::new(), scene(3, 5, 0))).await.unwrap().into_inner();
    assert_eq!((&after.actions, &after.recurrent_state), (&before.actions, &before.recurrent_state));
    assert_eq!(after.policy.unwrap().digest, reference.digest_hex());
    let next = client.act(held("mine", before.recurrent_state, scene(3, 5, 1))).await.unwrap().into_inner();
    assert_eq!(next.step, 1, "memory that the caller keeps outlives the server");
}

#[tokio::test]
async fn what_is_no_checkpoint_is_refused() {
    let server = Server::start().await;
    let good = checkpoint(Algorithm::Vdn, Preset::Paper, 1).to_bytes();
    let mut damaged = good.clone();
    let at = good.len() - 3;
    damaged[at..].copy_from_slice(&[0xff; 3]);
    let cases = [
        ("mine", b"hello".to_vec(), "checkpoint"),
        ("mine", good[..good.len() - 1].to_vec(), "checkpoint"),
        ("mine", damaged, "checkpoint"),
        ("mi ne", good.clone(), "name"),
        ("sweep", good, "name"),
    ];
    for (name, bytes, field) in cases {
        let refused = policies::publish_bytes(&server.app, Publisher::default(), name, bytes).await.unwrap_err();
        assert!(matches!(&refused, Error::Invalid(e) if e.field == field), "{refused}");
    }
    assert_eq!(server.app.store.policy_versions().await.unwrap().iter().filter(|v| v.name == "mine").count(), 0);
}

#[tokio::test]
async fn a_learned_policy_flies_like_all_others() {
    let server = Server::start().await;
    let mut client = server.grpc().await;
    for (name, preset) in [("practical", Preset::Practical), ("paper", Preset::Paper)] {
        let learned = checkpoint(Algorithm::Qedgix, preset, 7);
        publish(&server, name, &learned).await;
        let policy: &dyn qedgix::policy::Policy = &learned.policy();
        client.open_session(open(name, name)).await.unwrap();
        let mut memory = vec![0.0; policy.memory_len(3, 5)];
        policy.start(3, 5, 0, &mut memory);
        let mut state = Bytes::new();
        for step in 0..20 {
            let sent = scene(3, 5, step);
            let slot = FleetInput::try_from(sent.clone()).unwrap().into_fleet_graph(policy).unwrap();
            let (mut expected, mut q) = (vec![0; 3], vec![0.0; 3 * policy.actions()]);
            let (memory, headings) = (&mut memory[..], &mut expected[..]);
            policy.act(&mut [FleetStep {
                env: policy.env(),
                graph: &slot,
                profile: None,
                step,
                memory,
                headings,
                q_values: Some(&mut q),
            }]);

            let by_graph = v1::act_request::Observation::Graph(graph(&sent, policy.env().detection_range, true));
            let requests = [
                v1::ActRequest { observation: Some(by_graph), ..in_session(name, Some(step), sent.clone()) },
                held(name, state, sent),
            ];
            state = Bytes::new();
            for request in requests {
                let request = v1::ActRequest { return_q_values: true, ..request };
                let answer = client.act(request).await.unwrap().into_inner();
                let headings: Vec<u8> = answer.actions.iter().map(|a| a.heading_index as u8).collect();
                let values: Vec<f32> = answer.actions.iter().flat_map(|a| a.q_values.clone()).collect();
                assert_eq!((headings, values), (expected.clone(), q.clone()), "{name}, step {step}");
                state = answer.recurrent_state;
            }
        }
    }
    let paper = client.get_policy(v1::GetPolicyRequest { policy: "paper".into() }).await.unwrap().into_inner();
    assert_eq!((paper.uavs, paper.users), (Some(3), Some(5)));
    let (code, _, message) = refused(client.act(held("paper", Bytes::new(), scene(4, 5, 0))).await);
    assert_eq!(code, tonic::Code::InvalidArgument, "{message}");
    client.act(held("practical", Bytes::new(), scene(4, 9, 0))).await.unwrap();
}

#[tokio::test]
async fn the_reason_of_a_damaged_checkpoint_names_the_version() {
    let mut server = Server::start().await;
    publish(&server, "mine", &checkpoint(Algorithm::Vdn, Preset::Practical, 1)).await;
    policies::unload_policy(&server.app, "mine").await.unwrap();
    // After a restart, the version is not in memory.
    server.begin_stop();
    let server = with_timeout(server.restarted()).await;
    let file = server.dir.path().join(qedgix::store::FILE);
    let mut database = SqliteConnection::connect_with(&SqliteConnectOptions::new().filename(file)).await.unwrap();
    let sql = "UPDATE policy_versions SET checkpoint = substr(checkpoint, 2) WHERE name = 'mine'";
    sqlx::query(sql).execute(&mut database).await.unwrap();
    let error = policies::load_policy(&server.app, "mine").await.unwrap_err();
    assert_eq!(error.to_string(), "internal error", "callers do not see the cause");
    assert_eq!(error.reason(), "the checkpoint of mine:1 is damaged: its digest has changed");
}
