//! An evaluation within an attempt: runs the policies on the layouts and returns the report. It uses no network.

use std::sync::Arc;

use serde_json::json;

use super::StopSignal;
use super::training::{Report, ReportQueue};
use crate::checkpoint::Checkpoint;
use crate::env::EnvConfig;
use crate::invalid::Invalid;
use crate::jobs::evaluation::EvaluationSpec;
use crate::learner::{
    Comparison, Disturbance, PolicyEvaluation, SizingTarget, TracedEvaluation, Trajectory, evaluate_until, layout_list,
    layouts_per_part,
};
use crate::policy::{Policy, baselines};
use crate::store::WorkerResult;

/// An evaluation, and the checkpoints of its policies that are no baselines, by name.
pub(super) struct EvaluationTask {
    pub spec: EvaluationSpec,
    pub checkpoints: Vec<(String, Vec<u8>)>,
    pub threads: usize,
}

/// Evaluates all policies, or until `stop` is set. Returns the report as JSON if all are evaluated.
pub(super) fn evaluate(task: &EvaluationTask, reports: &ReportQueue, stop: &StopSignal) -> (WorkerResult, Option<String>) {
    match try_evaluate(task, reports, stop) {
        Ok(Some(report)) => (WorkerResult::Succeeded, Some(report)),
        Ok(None) => (WorkerResult::Stopped, None),
        // Another attempt would fail with the same policies and environment.
        Err(reason) => (WorkerResult::Failed { reason, permanent: true }, None),
    }
}

/// Tries fleets of growing size, as `qedgix plan` does.
fn try_plan(
    task: &EvaluationTask,
    target: &SizingTarget,
    reports: &ReportQueue,
    stop: &StopSignal,
) -> Result<Option<String>, String> {
    let EvaluationSpec { layouts, episodes, environment, policies, .. } = &task.spec;
    let name = policies.first().ok_or("no policy")?;
    let seeds = layout_list(layouts).map_err(|e| e.to_string())?.seeds(*episodes);
    let (policy, stop, mut fleets) = (task.open(name)?, stop.flag(), 0);
    let sizing = target.run(environment.slots, |uavs, lose| {
        let env = EnvConfig { uavs, hover: policy.actions() > EnvConfig::COMPASS, ..environment.clone() };
        env.validate()?;
        let disturbance = Disturbance { lose, ..Disturbance::default() };
        let mut metrics = Vec::with_capacity(seeds.len());
        for part in seeds.chunks(layouts_per_part(&env, 1)) {
            let Some(part) = evaluate_until(policy.as_ref(), &env, part, task.threads, &disturbance, &stop)? else {
                return Ok(None);
            };
            metrics.extend(part);
            reports.push(Report::Progress { step: (fleets * seeds.len() + metrics.len()) as u64 });
        }
        fleets += 1;
        Ok::<_, Invalid>(Some(metrics))
    });
    let Some(sizing) = sizing.map_err(|e| format!("policy {name}: {e}"))? else { return Ok(None) };
    let mut document = json!({
        "policy": name,
        "users": environment.users,
        "target_p95": target.target_p95,
        "layouts": layouts,
        "episodes": seeds.len(),
        "environment": environment,
    });
    sizing.add_to(&mut document);
    Ok(Some(document.to_string()))
}

fn try_evaluate(task: &EvaluationTask, reports: &ReportQueue, stop: &StopSignal) -> Result<Option<String>, String> {
    if let Some(target) = &task.spec.plan {
        return try_plan(task, target, reports, stop);
    }
    let EvaluationSpec { layouts: list, episodes, environment, disturbance, .. } = &task.spec;
    let list = layout_list(list).map_err(|e| e.to_string())?;
    let layouts = list.seeds(*episodes).len();
    let (mut policies, stop) = (Vec::new(), stop.flag());
    for (name, reference) in task.spec.all_policies() {
        let failed = |e: Invalid| format!("policy {name}: {e}");
        let policy = task.open(name)?;
        let env = EnvConfig { hover: policy.actions() > EnvConfig::COMPASS, ..environment.clone() };
        let mut metrics = Vec::with_capacity(layouts);
        for (env, seeds) in list.environments(&env, *episodes) {
            for part in seeds.chunks(layouts_per_part(&env, 1)) {
                let part = evaluate_until(policy.as_ref(), &env, part, task.threads, disturbance, &stop).map_err(failed)?;
                let Some(part) = part else { return Ok(None) };
                metrics.extend(part);
                reports.push(Report::Progress { step: (policies.len() * layouts + metrics.len()) as u64 });
            }
        }
        let evaluation = TracedEvaluation { episodes: metrics, aoi: Vec::new(), trajectory: Trajectory::default() };
        policies.push(PolicyEvaluation::new(name, reference, evaluation).map_err(failed)?);
    }
    let comparison =
        Comparison { layouts: list, episodes: layouts, env: environment.clone(), disturbance: *disturbance, policies };
    Ok(Some(comparison.json().map_err(|e| e.to_string())?.to_string()))
}

impl EvaluationTask {
    fn open(&self, name: &str) -> Result<Arc<dyn Policy>, String> {
        if let Some(policy) = baselines::by_name(name, (&self.spec.environment).into()) {
            return Ok(policy);
        }
        let found = self.checkpoints.iter().find(|(checkpoint, _)| checkpoint == name);
        let (_, bytes) = found.ok_or_else(|| format!("policy {name}: no checkpoint"))?;
        let checkpoint = Checkpoint::from_bytes(bytes).map_err(|e| format!("policy {name}: {e}"))?;
        Ok(Arc::new(checkpoint.policy()))
    }
}
