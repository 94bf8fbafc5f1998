//! Sequences: how they begin, go on, end, and are told apart. The policy `count` flies heading (seed + slot) mod 9.

use std::sync::Arc;

use jiff::Timestamp;
use qedgix::serving::{LoadedPolicy, MemoryShare, PolicyInfo, PolicyKind, PolicyRef};
use tonic::Code;

use super::*;

type Client = GrpcInferenceServiceClient<Channel>;

fn slot(model: &str, sequence: i64) -> Ask {
    Ask::new(model, As::Raw, false).scene(&narrow(2, 1, 0)).int("sequence_id", sequence)
}

fn start(model: &str, sequence: i64, seed: i64) -> Ask {
    slot(model, sequence).flag("sequence_start").int("seed", seed)
}

/// The heading that was flown, and by which version.
async fn fly(client: &mut Client, ask: Ask) -> (u32, String) {
    let answer = client.model_infer(ask.request).await.unwrap().into_inner();
    assert!(raw(&answer, "recurrent_state").is_none(), "memory stays on the server");
    (indices(&answer)[0], answer.model_version)
}

async fn fails(client: &mut Client, ask: Ask) -> (Code, String, String) {
    refused(client.model_infer(ask.request).await)
}

async fn counting() -> (Server, Client) {
    let server = Server::start().await;
    server.add("count", 1, Arc::new(TestPolicy::Count));
    server.add("other", 1, Arc::new(TestPolicy::Count));
    let client = client(&server).await;
    (server, client)
}

const NOT_STARTED: (Code, &str) = (Code::FailedPrecondition, "sequence_not_started");

#[tokio::test]
async fn a_sequence_begins_goes_on_and_ends() {
    let (server, mut client) = counting().await;
    let (code, reason, _) = fails(&mut client, slot("count", 7)).await;
    assert_eq!((code, reason.as_str()), NOT_STARTED);
    assert_eq!(fly(&mut client, start("count", 7, 2)).await.0, 2);
    assert_eq!(fly(&mut client, slot("count", 7)).await.0, 3);
    assert_eq!(server.app.sessions.len(), 1);
    assert_eq!(fly(&mut client, slot("count", 7).flag("sequence_end")).await.0, 4);
    assert_eq!(fails(&mut client, slot("count", 7)).await.1, NOT_STARTED.1);
    assert_eq!(fly(&mut client, start("count", 7, 5)).await.0, 5, "the id may be used again");
    let alone = start("count", 8, 6).flag("sequence_end");
    assert_eq!(fly(&mut client, alone).await.0, 6);
    assert_eq!(fails(&mut client, slot("count", 8)).await.1, NOT_STARTED.1);
}

#[tokio::test]
async fn sequences_are_told_apart() {
    let (_server, mut client) = counting().await;
    let named = |name: &str| {
        let ask = Ask::new("count", As::Raw, false).scene(&narrow(2, 1, 0));
        ask.with("sequence_id", ParameterChoice::StringParam(name.into()))
    };
    assert_eq!(fly(&mut client, start("count", 5, 0)).await.0, 0);
    assert_eq!(fly(&mut client, start("other", 5, 3)).await.0, 3, "another model's");
    assert_eq!(fly(&mut client, named("5").flag("sequence_start").int("seed", 5)).await.0, 5, "another type");
    assert_eq!(fly(&mut client, named("5\"").flag("sequence_start").int("seed", 7)).await.0, 7);
    assert_eq!(fly(&mut client, slot("count", 5)).await.0, 1);
    let unsigned = Ask::new("count", As::Raw, false).scene(&narrow(2, 1, 0)).with("sequence_id", ParameterChoice::Uint64Param(5));
    assert_eq!(fly(&mut client, unsigned).await.0, 2, "the same number however it is sent");
    assert_eq!(fly(&mut client, slot("other", 5)).await.0, 4);
    assert_eq!(fly(&mut client, named("5")).await.0, 6);
    assert_eq!(fly(&mut client, named("5\"")).await.0, 8);
    // 0 and nothing are no sequence: the caller keeps the memory.
    for none in [slot("count", 0), named("")] {
        let answer = client.model_infer(none.request).await.unwrap().into_inner();
        assert!(!state(&answer).is_empty());
    }
}

#[tokio::test]
async fn no_session_has_the_name_of_a_sequence() {
    let (server, mut client) = counting().await;
    let mut policies = server.grpc().await;
    let reserved = policies.open_session(open("count", "sequence:count:5")).await;
    assert_invalid(reserved, "session_id", "\"sequence:count:5\"");
    policies.open_session(open("count", "5")).await.unwrap();
    assert_eq!(fails(&mut client, slot("count", 5)).await.1, NOT_STARTED.1);
    fly(&mut client, start("count", 5, 0)).await;
    let list = policies.list_sessions(v1::ListSessionsRequest::default()).await.unwrap().into_inner().sessions;
    assert_eq!(list.iter().map(|s| s.session_id.as_str()).collect::<Vec<_>>(), ["5", "sequence:count:5"]);
    fly(&mut client, slot("count", 5).flag("sequence_end")).await;
    let list = policies.list_sessions(v1::ListSessionsRequest::default()).await.unwrap().into_inner().sessions;
    assert_eq!(list.len(), 1, "an ended sequence is not shown");
}

#[tokio::test]
async fn a_retry_by_step_advances_nothing() {
    let (server, mut client) = counting().await;
    for _ in 0..2 {
        assert_eq!(fly(&mut client, start("count", 5, 1).int("step", 0)).await.0, 1);
    }
    for _ in 0..3 {
        assert_eq!(fly(&mut client, slot("count", 5).int("step", 1)).await.0, 2);
    }
    for step in [0, 3, i64::MAX] {
        let (code, reason, _) = fails(&mut client, slot("count", 5).int("step", step)).await;
        assert_eq!((code, reason.as_str()), (Code::FailedPrecondition, "wrong_step"), "{step}");
    }
    assert_eq!(fails(&mut client, start("count", 5, 1).int("step", 1)).await.1, "wrong_step");
    let end = || slot("count", 5).int("step", 2).flag("sequence_end");
    for _ in 0..2 {
        assert_eq!(fly(&mut client, end()).await.0, 3, "the last answer may have been lost, too");
    }
    assert_eq!(fails(&mut client, slot("count", 5).int("step", 3)).await.1, NOT_STARTED.1);
    assert_eq!(fails(&mut client, slot("count", 5)).await.1, NOT_STARTED.1);
    server.app.sessions.remove_expired();
    assert_eq!(fly(&mut client, end()).await.0, 3);
    server.advance(11);
    server.app.sessions.remove_expired();
    assert!(server.app.sessions.is_empty());
    assert_eq!(fails(&mut client, end()).await.1, NOT_STARTED.1);
}

#[tokio::test]
async fn ended_sequences_make_room() {
    let server = Server::with(|config| config.max_sessions = 2).await;
    server.add("count", 1, Arc::new(TestPolicy::Count));
    let mut client = client(&server).await;
    for sequence in 1..20 {
        assert_eq!(fly(&mut client, start("count", sequence, 4).flag("sequence_end")).await.0, 4);
    }
    fly(&mut client, start("count", 21, 0)).await;
    fly(&mut client, start("count", 22, 0)).await;
    assert_eq!(fails(&mut client, start("count", 23, 0)).await.0, Code::ResourceExhausted);
    assert_eq!(fly(&mut client, start("count", 22, 6)).await.0, 6, "starting over takes no room");
}

#[tokio::test]
async fn a_start_starts_over_and_a_refused_one_does_not() {
    let (_server, mut client) = counting().await;
    fly(&mut client, start("count", 5, 0)).await;
    fly(&mut client, slot("count", 5)).await;
    let mut wrong = start("count", 5, 7);
    wrong.request.raw_input_contents[0] = Bytes::from_static(&[255; 16]);
    assert_eq!(fails(&mut client, wrong).await.0, Code::InvalidArgument);
    let four = Ask::new("count", As::Raw, false).scene(&narrow(4, 1, 0)).int("sequence_id", 5).flag("sequence_start");
    assert_eq!(fails(&mut client, four).await.2, "uavs");
    assert_eq!(fly(&mut client, slot("count", 5)).await.0, 2, "it went on");
    assert_eq!(fly(&mut client, start("count", 5, 7)).await.0, 7);
    assert_eq!(fly(&mut client, slot("count", 5)).await.0, 8);
    assert_eq!(fails(&mut client, slot("count", 5).int("seed", 3)).await.2, "seed");
    let state = slot("count", 5).byte_strings("recurrent_state", &[b"x"]);
    assert_eq!(fails(&mut client, state).await.2, "recurrent_state");
    assert_eq!(fails(&mut client, slot("count", 5).asking(&["recurrent_state"])).await.2, "outputs[0].name");
    let other_ids = || Ask::new("count", As::Raw, false).scene(&narrow(2, 1, 0)).int("sequence_id", 5);
    let repeated = other_ids().int("step", 1);
    assert_eq!(
        fails(&mut client, repeated.byte_strings("uav_ids", &["a", "b"])).await.2,
        "uavs",
        "a repetition lists the same UAVs"
    );
}

#[tokio::test]
async fn a_start_that_was_not_answered_did_not_begin() {
    let server = Server::with(|config| config.engine.threads = 1).await;
    let gate = Arc::new(Gate::default());
    server.add("slow", 1, Arc::new(TestPolicy::Wait(gate.clone())));
    let mut client = client(&server).await;
    // In microseconds.
    let (code, reason, _) = fails(&mut client, start("slow", 5, 1).int("timeout", 30_000)).await;
    assert_eq!((code, reason.as_str()), (Code::DeadlineExceeded, "deadline_exceeded"));
    assert!(server.app.sessions.is_empty());
    gate.open();
    assert_eq!(fails(&mut client, slot("slow", 5)).await.1, NOT_STARTED.1);
    assert_eq!(fly(&mut client, start("slow", 5, 1)).await.0, 1);
}

#[tokio::test]
async fn a_sequence_stays_with_the_version_it_began_with() {
    let (server, mut client) = counting().await;
    assert_eq!(fly(&mut client, start("count", 5, 0)).await, (0, "1".into()));
    server.add("count", 2, Arc::new(TestPolicy::Count));
    server.app.registry.set_alias("count", "live", 2);
    assert_eq!(fly(&mut client, slot("count", 5)).await, (1, "1".into()));
    assert_eq!(fly(&mut client, slot("count@live", 5)).await, (2, "1".into()));
    assert_eq!(fly(&mut client, slot("count:1", 5)).await, (3, "1".into()));
    let (code, _, field) = fails(&mut client, slot("count:2", 5)).await;
    assert_eq!((code, field.as_str()), (Code::InvalidArgument, "model_name"));
    assert_eq!(fly(&mut client, start("count@live", 5, 0)).await, (0, "2".into()));
    let mut older = start("count", 6, 0);
    older.request.model_version = "1".into();
    assert_eq!(fly(&mut client, older).await, (0, "1".into()));
}

#[tokio::test]
async fn idle_sequences_expire_and_say_so() {
    let (server, mut client) = counting().await;
    fly(&mut client, start("count", 5, 0)).await;
    server.advance(601);
    let (code, reason, _) = fails(&mut client, slot("count", 5)).await;
    assert_eq!((code, reason.as_str()), (Code::FailedPrecondition, "session_expired"));
    assert_eq!(fly(&mut client, start("count", 5, 3)).await.0, 3);
}

#[tokio::test]
async fn an_unloaded_model_is_refused_and_its_sequences_go_on() {
    let (server, mut client) = counting().await;
    fly(&mut client, start("count", 5, 0)).await;
    let unload = |name: &str| oip::RepositoryModelUnloadRequest { model_name: name.into(), ..Default::default() };
    let load = |name: &str| oip::RepositoryModelLoadRequest { model_name: name.into(), ..Default::default() };
    client.repository_model_unload(unload("count")).await.unwrap();
    for ask in [start("count", 6, 0), start("count:1", 5, 0), slot("count", 0)] {
        let (code, reason, _) = fails(&mut client, ask).await;
        assert_eq!((code, reason.as_str()), (Code::FailedPrecondition, "policy_unloaded"));
    }
    let ready = |name: &str| oip::ModelReadyRequest { name: name.into(), version: String::new() };
    assert!(!client.model_ready(ready("count")).await.unwrap().into_inner().ready);
    assert!(client.model_ready(ready("other")).await.unwrap().into_inner().ready);
    let index = async |client: &mut Client, ready| {
        let request = oip::RepositoryIndexRequest { ready, ..Default::default() };
        let models = client.repository_index(request).await.unwrap().into_inner().models;
        let found = models.into_iter().find(|model| model.name == "count");
        found.map(|model| (model.version, model.state, model.reason.is_empty()))
    };
    assert_eq!(index(&mut client, false).await, Some(("1".into(), "UNAVAILABLE".into(), false)));
    assert_eq!(index(&mut client, true).await, None);
    assert_eq!(fly(&mut client, slot("count", 5)).await.0, 1, "under way");
    server.add("count", 1, Arc::new(TestPolicy::Count));
    client.repository_model_unload(unload("sweep")).await.unwrap();
    assert!(!client.model_ready(ready("sweep")).await.unwrap().into_inner().ready);
    client.repository_model_load(load("sweep")).await.unwrap();
    assert!(client.model_ready(ready("sweep")).await.unwrap().into_inner().ready);
    assert_eq!(index(&mut client, true).await, Some(("1".into(), "READY".into(), true)));
    assert_eq!(fly(&mut client, slot("count", 5).flag("sequence_end")).await.0, 2);
    assert_eq!(fly(&mut client, start("count", 6, 0)).await.0, 0);
    assert_eq!(refused(client.repository_model_load(load("nobody")).await).0, Code::NotFound);
    assert_eq!(refused(client.repository_model_unload(unload("nobody")).await).0, Code::NotFound);
    let elsewhere = oip::RepositoryIndexRequest { repository_name: "other".into(), ready: false };
    assert_invalid(client.repository_index(elsewhere).await, "repository_name", "\"other\"");
    let mut changed = load("count");
    changed.parameters.insert("config".into(), oip::ModelRepositoryParameter::default());
    assert_invalid(client.repository_model_load(changed).await, "parameters", "\"config\"");
    drop(server);
}

#[tokio::test]
async fn a_stream_is_answered_in_order_and_outlives_errors() {
    let (mut server, mut client) = counting().await;
    let asks = vec![
        start("count", 1, 0),
        slot("count", 1),
        slot("nobody", 1),
        start("other", 1, 5).flag("triton_enable_empty_final_response"),
        slot("count", 1).int("step", 9),
        slot("count", 1).flag("sequence_end"),
    ];
    let (send, requests) = tokio::sync::mpsc::channel(10);
    for (i, ask) in asks.into_iter().enumerate() {
        let request = oip::ModelInferRequest { id: i.to_string(), ..ask.request };
        send.send(request).await.unwrap();
    }
    let requests = tokio_stream::wrappers::ReceiverStream::new(requests);
    let mut answers = client.model_stream_infer(requests).await.unwrap().into_inner();
    let expected = [Ok(0), Ok(1), Err("not_found"), Ok(5), Err("wrong_step"), Ok(2)];
    for (i, expected) in expected.into_iter().enumerate() {
        let answer = with_timeout(answers.message()).await.unwrap().unwrap();
        let response = answer.infer_response.unwrap();
        assert_eq!(response.id, i.to_string());
        let told = |name: &str| response.parameters.get(name).and_then(|p| p.parameter_choice.clone());
        assert_eq!(told("triton_final_response"), Some(ParameterChoice::BoolParam(true)));
        match expected {
            Ok(heading) => assert_eq!((answer.error_message.as_str(), indices(&response)[0]), ("", heading)),
            Err(code) => {
                assert!(!answer.error_message.is_empty() && response.outputs.is_empty());
                assert_eq!(told("code"), Some(ParameterChoice::StringParam(code.into())));
            }
        }
    }
    // A stream that is open does not hold up the end of the server.
    server.begin_stop();
    assert!(with_timeout(answers.message()).await.unwrap().is_none());
    drop(send);
    with_timeout(server.stopped()).await;
}

#[tokio::test]
async fn metadata_says_what_a_policy_takes() {
    let server = Server::start().await;
    let reference = PolicyRef { name: "fixed".into(), version: 3, digest: [3; 32] };
    let policy = LoadedPolicy::baseline(reference, "of a test", Arc::new(TestPolicy::Count), Timestamp::UNIX_EPOCH);
    let info = PolicyInfo { kind: PolicyKind::Checkpoint, uavs: Some(3), ..(*policy.info).clone() };
    server.app.registry.insert(LoadedPolicy::new(Arc::new(info), policy.implementation, MemoryShare::default()));
    let mut client = client(&server).await;
    let ask = |name: &str| oip::ModelMetadataRequest { name: name.into(), version: String::new() };
    let fixed = client.model_metadata(ask("fixed")).await.unwrap().into_inner();
    assert_eq!((fixed.platform.as_str(), fixed.versions), ("qedgix", vec!["3".to_owned()]));
    let shapes: HashMap<_, _> = fixed.inputs.iter().chain(&fixed.outputs).map(|t| (t.name.as_str(), t.shape.clone())).collect();
    assert_eq!(shapes["uav_positions"], [3, 2]);
    assert_eq!(shapes["user_aoi"], [-1]);
    assert_eq!(shapes["q_values"], [3, 9]);
    let names =
        |tensors: &[oip::model_metadata_response::TensorMetadata]| tensors.iter().map(|t| t.name.clone()).collect::<Vec<_>>();
    let tour = client.model_metadata(ask("tour")).await.unwrap().into_inner();
    assert!(!names(&tour.inputs).iter().any(|name| name.starts_with("edge")), "a scene only");
    assert!(!names(&tour.outputs).contains(&"q_values".to_owned()), "it has none");
    let config = |name: &str| oip::ModelConfigRequest { name: name.into(), version: String::new() };
    let config = client.model_config(config("fixed")).await.unwrap().into_inner().config.unwrap();
    assert_eq!(config.sequence_batching.unwrap().max_sequence_idle_microseconds, 600_000_000);
    assert!(config.input.iter().all(|input| input.data_type() != oip::DataType::TypeInvalid));
    let needed: Vec<_> = config.input.iter().filter(|input| !input.optional).map(|input| input.name.as_str()).collect();
    assert_eq!(needed, ["uav_positions", "user_aoi"]);
    server.app.draining.begin();
    assert!(!client.server_ready(oip::ServerReadyRequest {}).await.unwrap().into_inner().ready);
    assert!(client.server_live(oip::ServerLiveRequest {}).await.unwrap().into_inner().live);
}
