//! Finding and comparing jobs: filters, orders, metrics in lists, edits, and why a job waits.

use std::collections::BTreeMap;
use std::time::Instant;

use jiff::Timestamp;
use qedgix::api::convert::structs::to_struct;
use qedgix::store::{JobFilter, JobId, JobList, JobOrder, JobSort, JobSpec, NewJob, Store};
use qedgix::train_config::{Algorithm, Preset, TrainConfig};
use qedgix::wire::v1;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use tonic::Code;

use super::harness::{Server, Worker, expect, named, signed, with};

/// Ids of a list, all pages, two jobs to a page.
async fn list(server: &Server, query: &str) -> Vec<String> {
    let (mut ids, mut token) = (Vec::new(), String::new());
    loop {
        let page = server.get(&format!("/v1/jobs?page_size=2&{query}&page_token={token}")).await;
        ids.extend(page["jobs"].as_array().unwrap().iter().map(|job| job["id"].as_str().unwrap().to_owned()));
        page["next_page_token"].as_str().unwrap().clone_into(&mut token);
        if token.is_empty() {
            return ids;
        }
    }
}

async fn report(server: &Server, worker: &Worker, rows: &[(&str, u64, f64)]) {
    let metric = |&(name, step, value): &(&str, u64, f64)| v1::ReportedMetric { name: name.into(), step, value };
    let request = v1::ReportRequest { metrics: rows.iter().map(metric).collect(), step: rows[0].1 };
    server.worker_client().await.report(signed(&worker.launch, &worker.launch.token, request)).await.unwrap();
}

#[tokio::test]
async fn jobs_are_filtered_by_what_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let server = Server::start(dir.path(), 1).await;
    let jobs = [
        with(&json!({"name": "night-1", "algorithm": "qmix", "labels": {"team": "a", "urgent": "yes"}})),
        with(&json!({"name": "night-2", "labels": {"team": "b", "urgent": "no"}})),
        with(&json!({"name": "day", "labels": {"team": "a"}})),
        with(&json!({})),
    ];
    let mut ids = Vec::new();
    for job in &jobs {
        ids.push(server.submit(job).await);
    }
    // The first runs; the others wait.
    server.reaches(&ids[0], "running").await;
    let created = server.get(&format!("/v1/jobs/{}", ids[2])).await["created_at"].as_str().unwrap().to_owned();
    for (query, expected) in [
        ("kind=train", vec![3, 2, 1, 0]),
        ("state=running", vec![0]),
        ("state=queued&sort=created", vec![1, 2, 3]),
        ("algorithm=qmix", vec![0]),
        ("name=night-2", vec![1]),
        ("name=night-*&sort=name", vec![0, 1]),
        ("labels=team%3Da", vec![2, 0]),
        ("labels=urgent", vec![1, 0]),
        ("labels=urgent,team%3Da", vec![0]),
        ("labels=absent", vec![]),
        ("sort=name", vec![2, 0, 1, 3]),
        ("sort=-name&state=queued", vec![1, 2, 3]),
        ("parent=00000000-0000-0000-0000-000000000000", vec![]),
        (&format!("created_after={created}"), vec![3, 2]),
        (&format!("created_before={created}"), vec![1, 0]),
    ] {
        let expected: Vec<&String> = expected.into_iter().map(|i: usize| &ids[i]).collect();
        assert_eq!(list(&server, query).await.iter().collect::<Vec<_>>(), expected, "{query}");
    }
    for (query, field) in [
        ("kind=dance", "kind"),
        ("algorithm=dqn", "algorithm"),
        ("name=a b", "name"),
        ("labels=%3Da", "labels"),
        ("parent=me", "parent"),
        ("created_after=yesterday", "created_after"),
        ("sort=age", "sort"),
        ("metrics=a%20b", "metrics"),
        ("metrics=loss,eval/mean_ao", "metrics"),
        ("sort=best:eval/mean_ao", "sort"),
        ("sort=name&page_token=7", "page_token"),
        ("page_token=a~7", "page_token"),
    ] {
        let problem = expect(server.request(Method::GET, &format!("/v1/jobs?{query}")), StatusCode::BAD_REQUEST).await;
        assert_eq!(problem["field"], field, "{query}: {problem}");
    }

    let mut grpc = server.jobs().await;
    let mut listed = async |request: v1::ListJobsRequest| {
        let jobs = grpc.list_jobs(request).await.map(|page| page.into_inner().jobs);
        jobs.map(|jobs| jobs.into_iter().map(|job| job.id).collect::<Vec<_>>()).map_err(|status| status.code())
    };
    let at = |text: &str| text.parse::<Timestamp>().unwrap();
    let created = prost_types::Timestamp { seconds: at(&created).as_second(), nanos: at(&created).subsec_nanosecond() };
    let all = v1::ListJobsRequest::default();
    let request = v1::ListJobsRequest { name: "night-*".into(), algorithm: "vdn".into(), kind: "train".into(), ..all.clone() };
    assert_eq!(listed(request).await, Ok(vec![ids[1].clone()]));
    let request = v1::ListJobsRequest { created_before: Some(created), sort: "created".into(), ..all.clone() };
    assert_eq!(listed(request).await, Ok(ids[..2].to_vec()));
    for wrong in [
        v1::ListJobsRequest { kind: "dance".into(), ..all.clone() },
        v1::ListJobsRequest { algorithm: "dqn".into(), ..all.clone() },
        v1::ListJobsRequest { created_after: Some(prost_types::Timestamp { seconds: i64::MAX, nanos: 0 }), ..all.clone() },
    ] {
        assert_eq!(listed(wrong).await, Err(Code::InvalidArgument));
    }
}

#[tokio::test]
async fn jobs_are_sorted_by_the_best_and_the_last_value_of_a_metric() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 3).await;
    let (mut ids, mut workers) = (Vec::new(), Vec::new());
    for name in ["a", "b", "c"] {
        ids.push(server.submit(&named(name)).await);
        workers.push(server.worker().await);
    }
    ids.push(server.submit(&named("queued")).await);
    // Best: a 3, b 2, c none. Last: a 3, b 5.
    report(&server, &workers[0], &[("eval/mean_aoi", 0, 9.0), ("eval/mean_aoi", 20, 3.0), ("eval/coverage", 20, 0.25)]).await;
    report(&server, &workers[1], &[("eval/mean_aoi", 0, 2.0), ("loss", 10, 1.0), ("eval/coverage", 20, 0.5)]).await;
    report(&server, &workers[1], &[("eval/mean_aoi", 20, 5.0), ("eval/coverage", 40, 0.125)]).await;
    report(&server, &workers[2], &[("eval/mean_aoi", 0, f64::NAN)]).await;
    for (sort, expected) in [
        ("best:eval/mean_aoi", [1, 0, 3, 2]),
        ("-best:eval/mean_aoi", [0, 1, 3, 2]),
        ("last:eval/mean_aoi", [0, 1, 3, 2]),
        ("-last:eval/mean_aoi", [1, 0, 3, 2]),
        ("-best:eval/coverage", [1, 0, 3, 2]),
        ("last:eval/coverage", [1, 0, 3, 2]),
        ("last:epsilon", [3, 2, 1, 0]),
    ] {
        let expected = expected.map(|i: usize| ids[i].clone());
        assert_eq!(list(&server, &format!("sort={sort}")).await, expected, "{sort}");
    }
    assert_eq!(list(&server, "sort=best:eval/mean_aoi&state=running").await, [1, 0, 2].map(|i: usize| ids[i].clone()));

    let page = server.get("/v1/jobs?sort=created&metrics=eval/mean_aoi,eval/coverage").await;
    let metrics: Vec<&Value> = page["jobs"].as_array().unwrap().iter().map(|job| &job["metrics"]).collect();
    let expected = json!({
        "eval/coverage": {"best": 0.5, "best_step": 20, "last": 0.125, "last_step": 40},
        "eval/mean_aoi": {"best": 2.0, "best_step": 0, "last": 5.0, "last_step": 20},
    });
    assert_eq!(metrics[1], &expected);
    assert_eq!(metrics[2]["eval/mean_aoi"], json!({"best": null, "best_step": null, "last": null, "last_step": 0}));
    assert_eq!(metrics[3], &json!({}));
    let job = server.get(&format!("/v1/jobs/{}", ids[1])).await;
    assert_eq!(job["metrics"]["loss"]["last"], 1.0);
    let mut grpc = server.jobs().await;
    let job = grpc.get_job(v1::GetJobRequest { id: ids[1].clone() }).await.unwrap().into_inner();
    assert_eq!(job.metrics["eval/mean_aoi"].best, Some(2.0));
}

#[tokio::test]
async fn jobs_are_edited_in_any_state() {
    let dir = tempfile::tempdir().unwrap();
    let mut server = Server::start(dir.path(), 1).await;
    let running = server.submit(&with(&json!({"labels": {"a": "1", "b": "2"}, "notes": "first"}))).await;
    let worker = server.worker().await;
    let low = server.submit(&named("low")).await;
    let high = server.submit(&named("high")).await;
    let rest = server.rest.clone();
    let patch = |id: &str, body: Value| rest.request(Method::PATCH, &format!("/v1/jobs/{id}")).json(&body);
    let job = server.get(&format!("/v1/jobs/{running}")).await;
    assert_eq!((&job["notes"], &job["parent"]), (&json!("first"), &json!(null)));

    let changes = json!({"name": "better", "labels": {"b": null, "c": "3"}, "notes": "line 1\nline 2"});
    let job = expect(patch(&running, changes), StatusCode::OK).await;
    assert_eq!((&job["name"], &job["labels"]), (&json!("better"), &json!({"a": "1", "c": "3"})));
    assert_eq!((&job["notes"], &job["unreadable"]), (&json!("line 1\nline 2"), &json!(null)));
    assert_eq!(list(&server, "labels=c").await, std::slice::from_ref(&running));
    assert_eq!(list(&server, "labels=b").await, [""; 0]);
    let job = expect(patch(&running, json!({"labels": null, "name": null, "notes": null})), StatusCode::OK).await;
    assert_eq!((&job["name"], &job["labels"], &job["notes"]), (&json!(null), &json!({}), &json!("")));
    let job = expect(patch(&running, json!({})), StatusCode::OK).await;
    assert_eq!(job["training"]["steps"], 400);

    // A higher priority comes first.
    let waiting = server.get(&format!("/v1/jobs/{high}")).await["waiting"].clone();
    assert_eq!(waiting["reason"], "needs 1 thread, 0 free; 1 job before it");
    let job = expect(patch(&high, json!({"priority": 3.0})), StatusCode::OK).await;
    assert_eq!((&job["priority"], &job["waiting"]["jobs_before"]), (&json!(3), &json!(0)));
    let mut grpc = server.jobs().await;
    let changes = to_struct(&json!({"notes": "over gRPC"}));
    let job = grpc.edit_job(v1::EditJobRequest { id: low.clone(), changes }).await.unwrap().into_inner();
    assert_eq!((job.notes.as_str(), job.waiting.unwrap().jobs_before), ("over gRPC", 1));
    worker.exit("exit code 1");
    let next = server.worker().await;
    assert_eq!(next.job(), high);
    assert_eq!(server.get(&format!("/v1/jobs/{high}")).await["waiting"], json!(null));

    for (body, status, field) in [
        (json!({"name": "a:b"}), 400, "name"),
        (json!({"name": "random"}), 400, "name"),
        (json!({"priority": 101}), 400, "priority"),
        (json!({"labels": {"a b": "c"}}), 400, "labels"),
        (json!({"notes": "\u{0}"}), 400, "notes"),
        (json!({"notes": 3}), 422, "notes"),
        (json!({"labels": {"a": 1}}), 422, "labels.a"),
        (json!({"threads": 2}), 422, "threads"),
        (json!([]), 422, "body"),
    ] {
        let problem = expect(patch(&low, body.clone()), StatusCode::from_u16(status).unwrap()).await;
        assert_eq!(problem["field"], field, "{body}: {problem}");
    }
    expect(patch(&uuid::Uuid::nil().to_string(), json!({})), StatusCode::NOT_FOUND).await;
}

/// Measures lists of many queued jobs; asserts what they return. `QEDGIX_LISTED_JOBS=10000` is the long form.
#[tokio::test]
async fn many_jobs_are_listed() {
    let jobs: usize = std::env::var("QEDGIX_LISTED_JOBS").map_or(200, |text| text.parse().unwrap());
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(dir.path()).await.unwrap();
    let config = TrainConfig::preset(Algorithm::Qmix, Preset::Practical);
    let mut submits = Vec::new();
    for i in 0..jobs {
        let labels = BTreeMap::from([("group".to_owned(), (i % 50).to_string())]);
        let name = Some(format!("job-{:05}", (i * 7919) % jobs));
        let spec = JobSpec { name, labels, ..JobSpec::train(config.clone()) };
        let (id, now) = (JobId(uuid::Uuid::now_v7()), Timestamp::now());
        let begin = Instant::now();
        let (notes, parent) = (String::new(), None);
        let new = NewJob { id, owner: None, any_name: false, spec, notes, parent, beginning: None, now, idempotency: None };
        store.submit_job(new).await.unwrap();
        submits.push(begin.elapsed());
    }
    submits.sort();
    println!("submit: p50 {:?}, p99 {:?}", submits[jobs / 2], submits[jobs * 99 / 100]);
    let filter = JobFilter::default();
    for filter in [
        filter.clone(),
        JobFilter { labels: [("group".into(), Some("7".into()))].into(), ..filter.clone() },
        JobFilter { labels: [("group".into(), Some("none".into()))].into(), ..filter.clone() },
        JobFilter { algorithm: Some(Algorithm::Vdn), ..filter.clone() },
        JobFilter { name: Some("job-0000*".into()), ..filter },
    ] {
        for by in [JobSort::Created, JobSort::Name, JobSort::Best("eval/mean_aoi".into())] {
            let order = JobOrder { by: by.clone(), descending: true };
            let list = JobList { filter: filter.clone(), order, after: None, limit: 100, max_bytes: 1 << 20 };
            let begin = Instant::now();
            let (listed, _) = store.jobs(&list).await.unwrap();
            println!(
                "{:?} by {by:?}: {} jobs in {:?}",
                (&filter.labels, &filter.algorithm, &filter.name),
                listed.len(),
                begin.elapsed()
            );
            let sorted = listed.windows(2).all(|pair| match by {
                JobSort::Name => pair[0].job.spec.name >= pair[1].job.spec.name,
                _ => pair[0].job.row_id > pair[1].job.row_id,
            });
            assert!(sorted && listed.len() <= 100);
        }
    }
    store.close().await;
    let begin = Instant::now();
    let server = Server::start(dir.path(), 1).await;
    server.get("/v1/jobs?page_size=1").await;
    println!("start: {:?}", begin.elapsed());
    for query in ["", "&sort=name&labels=group%3D7", "&state=queued&sort=-best:eval/mean_aoi&metrics=loss", "&algorithm=vdn"] {
        let begin = Instant::now();
        let page = server.get(&format!("/v1/jobs?page_size=100{query}")).await;
        println!("GET {query}: {} jobs in {:?}", page["jobs"].as_array().unwrap().len(), begin.elapsed());
    }
}
