//! Space of the database file: what deleted records leave, old files, and the rules of retention.

use std::collections::BTreeMap;
use std::path::Path;

use jiff::Timestamp;
use qedgix::store::{
    CheckpointKind, EndedAttempt, FILE, JobAction, JobId, JobSpec, Lease, NewCheckpoint, NewJob, Store, SubmitResult,
    WorkerResult,
};
use qedgix::train_config::{Algorithm, Preset, TrainConfig};
use sqlx::SqlitePool;
use sqlx::migrate::Migrator;

const NOW: Timestamp = Timestamp::UNIX_EPOCH;

/// A new job that is running, and its attempt.
async fn running(store: &Store) -> Lease {
    let config = TrainConfig::preset(Algorithm::Qmix, Preset::Practical);
    let spec = JobSpec::train(config);
    let new = NewJob {
        id: JobId(uuid::Uuid::now_v7()),
        owner: None,
        any_name: false,
        spec,
        notes: String::new(),
        beginning: None,
        parent: None,
        now: NOW,
        idempotency: None,
    };
    let SubmitResult::Created(job) = store.submit_job(new).await.unwrap() else { panic!("a new job") };
    store.begin_attempt(job.id, [0; 32], NOW).await.unwrap().unwrap()
}

/// A store with a running job, and its attempt.
pub async fn running_job(dir: &Path) -> (Store, Lease) {
    let store = Store::open(dir).await.unwrap();
    let lease = running(&store).await;
    (store, lease)
}

async fn end(store: &Store, lease: Lease) {
    let ended =
        EndedAttempt { lease, result: &WorkerResult::Succeeded, publish: None, document: None, max_attempts: 3, now: NOW };
    store.end_attempt(ended).await.unwrap().unwrap();
}

async fn add_checkpoint(store: &Store, lease: Lease, kind: CheckpointKind, bytes: Vec<u8>) {
    let sha256 = qedgix::checkpoint::digest(&bytes);
    let new = NewCheckpoint { kind, step: 1, sha256, metrics: BTreeMap::new(), bytes };
    store.store_checkpoint(lease, new, NOW).await.unwrap().unwrap();
}

async fn give_back(store: &Store) {
    for _ in 0..store.free_pages().await.unwrap().div_ceil(Store::STEP_PAGES) {
        store.give_back_step().await.unwrap();
    }
}

#[tokio::test]
async fn deleted_jobs_leave_no_space_in_the_file() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(dir.path()).await.unwrap();
    assert!(store.can_give_back().await.unwrap());
    let before = store.pages().await.unwrap();
    let mut jobs = Vec::new();
    for i in 0..200_u8 {
        let lease = running(&store).await;
        add_checkpoint(&store, lease, CheckpointKind::Best, vec![i; 100_000]).await;
        let mut snapshot = store.begin_snapshot(lease, 1, NOW).await.unwrap().unwrap();
        store.append_snapshot(&mut snapshot, &vec![i; 200_000]).await.unwrap();
        end(&store, lease).await;
        jobs.push(lease.job_id);
    }
    assert!(store.pages().await.unwrap() > before + 5_000);
    for id in jobs {
        store.change_job(id, JobAction::Delete, NOW).await.unwrap();
    }
    give_back(&store).await;
    let after = store.pages().await.unwrap();
    assert!(after <= before + 8, "{before} pages before, {after} after");
    assert_eq!(store.free_pages().await.unwrap(), 0);
}

/// A file as the migrations before number 7 made it, with a version, an alias and its history.
async fn old_file(dir: &Path) {
    let all = Migrator::new(Path::new(env!("CARGO_MANIFEST_DIR")).join("migrations")).await.unwrap();
    let old = Migrator::with_migrations(all.iter().filter(|migration| migration.version < 6).cloned().collect());
    let file = dir.join(FILE);
    let database = SqlitePool::connect(&format!("sqlite://{}?mode=rwc", file.display())).await.unwrap();
    old.run(&database).await.unwrap();
    for sql in [
        "INSERT INTO policies VALUES ('mine', 0)",
        "INSERT INTO policy_versions VALUES ('mine', 1, 'a', x'01', 0), ('mine', 2, 'b', x'02', 0)",
        "INSERT INTO policy_aliases VALUES ('mine', 'live', 2)",
        "INSERT INTO policy_promotions VALUES (3, 'mine', 'live', 1, NULL, 0, 'key'), (4, 'mine', 'live', 2, 1, 0, NULL)",
    ] {
        sqlx::query(sql).execute(&database).await.unwrap();
    }
    database.close().await;
}

#[tokio::test]
async fn a_file_of_an_older_version_keeps_its_content_and_gives_space_back_after_it_was_rewritten() {
    let dir = tempfile::tempdir().unwrap();
    old_file(dir.path()).await;
    let store = Store::open(dir.path()).await.unwrap();
    assert!(!store.can_give_back().await.unwrap());
    store.rewrite().await.unwrap();
    // Connections that were open before remember the former setting.
    store.close().await;
    let store = Store::open(dir.path()).await.unwrap();
    assert!(store.can_give_back().await.unwrap());
    let versions: Vec<u64> = store.policy_versions().await.unwrap().into_iter().map(|v| v.version).collect();
    assert_eq!(versions, [1, 2]);
    let filter = qedgix::store::AliasHistoryFilter { name: "mine", alias: Some("live"), before: None };
    let history = store.alias_history(filter, 10).await.unwrap();
    let history: Vec<_> = history.into_iter().map(|m| (m.id, m.version, m.previous, m.by)).collect();
    assert_eq!(history, [(4, Some(2), Some(1), None), (3, Some(1), None, Some("key".to_owned()))]);

    // An alias keeps its version, and numbers go on after the largest that was ever given.
    store.delete_policy_versions("mine", &[1, 2]).await.unwrap_err();
    let at = qedgix::store::AliasMove { name: "mine", alias: "live", to: None, at: NOW, by: None };
    store.move_policy_alias(at).await.unwrap();
    store.delete_policy_versions("mine", &[1, 2]).await.unwrap();
    let (digest, checkpoint, info) = ("c", &b"c"[..], "{}");
    let (name, now, alias, by, owner, any_name) = ("mine", NOW, None, None, None, true);
    let new = qedgix::store::NewPolicyVersion { name, digest, checkpoint, info, now, alias, by, owner, any_name };
    assert_eq!(store.publish_policy(new).await.unwrap().unwrap().version, 3);
    assert_eq!(store.policy_info("mine", 3).await.unwrap().as_deref(), Some("{}"));
}

#[tokio::test]
async fn checkpoints_of_ended_jobs_are_trimmed_the_best_last() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(dir.path()).await.unwrap();
    let mut jobs = Vec::new();
    for (kinds, ended) in [
        (&[CheckpointKind::Last, CheckpointKind::Best][..], true),
        (&[CheckpointKind::Last], true),
        (&[CheckpointKind::Best, CheckpointKind::Last], false),
    ] {
        let lease = running(&store).await;
        for &kind in kinds {
            add_checkpoint(&store, lease, kind, vec![1]).await;
        }
        if ended {
            end(&store, lease).await;
        }
        jobs.push(lease.job_id);
    }
    let last = store.last_job().await.unwrap();
    assert_eq!(store.trim_checkpoints(1..=last, 2).await.unwrap(), 0);
    assert_eq!(store.trim_checkpoints(2..=last, 1).await.unwrap(), 0, "the first job is out of range");
    assert_eq!(store.trim_checkpoints(1..=last, 1).await.unwrap(), 1);
    let mut kept = Vec::new();
    for id in jobs {
        kept.push(store.checkpoints(id).await.unwrap().into_iter().map(|c| c.kind).collect::<Vec<_>>());
    }
    assert_eq!(kept[..2], [[CheckpointKind::Best], [CheckpointKind::Last]]);
    assert_eq!(kept[2].len(), 2, "a running job keeps all");
}
