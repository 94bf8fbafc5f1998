//! What each gRPC method and REST route requires of a caller. What is not listed requires the scope `admin`.

use std::collections::HashMap;
use std::sync::LazyLock;

use axum::http::Method;

use crate::service::keys::Scope;

/// What a request requires.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Requirement {
    /// No key: probes, documentation, and workers, which authenticate with the token of their attempt.
    NoKey,
    /// Any key: the route is unknown. A caller with a valid key gets 404, any other 401.
    AnyKey,
    /// A key with this scope.
    Scope(Scope),
}

const OPEN: Requirement = Requirement::NoKey;
const READ: Requirement = Requirement::Scope(Scope::Read);
const ACT: Requirement = Requirement::Scope(Scope::Act);
const JOBS: Requirement = Requirement::Scope(Scope::Jobs);
const ADMIN: Requirement = Requirement::Scope(Scope::Admin);

/// Service, methods (`*`: all) and their requirement.
const GRPC: &[(&str, &str, Requirement)] = &[
    ("qedgix.v1.PolicyService", "Act ActBatch ActStream Encode Decide OpenSession CloseSession", ACT),
    ("qedgix.v1.PolicyService", "GetSession ListSessions GetPolicy ListPolicies ListPolicyVersions", READ),
    ("qedgix.v1.PolicyService", "DeletePolicy DeletePolicyVersion", ADMIN),
    ("qedgix.v1.EnvironmentService", "CreateEnvironment Reset Step DeleteEnvironment", ACT),
    ("qedgix.v1.EnvironmentService", "GetEnvironment", READ),
    ("dm_env_rpc.v1.Environment", "Process", ACT),
    ("qedgix.v1.JobService", "SubmitJob EditJob CancelJob PauseJob ResumeJob RetryJob ContinueJob DeleteJob", JOBS),
    (
        "qedgix.v1.JobService",
        "GetJob ListJobs GetJobMetrics WatchJob GetJobLogs GetJobResult WatchJobLogs ListCheckpoints DownloadCheckpoint",
        READ,
    ),
    ("qedgix.v1.WorkerService", "*", OPEN),
    ("inference.GRPCInferenceService", "ServerLive ServerReady", OPEN),
    ("inference.GRPCInferenceService", "ServerMetadata ModelReady ModelMetadata ModelConfig", READ),
    ("inference.GRPCInferenceService", "RepositoryIndex ModelStatistics TraceSetting LogSettings", READ),
    ("inference.GRPCInferenceService", "SystemSharedMemoryStatus CudaSharedMemoryStatus", READ),
    ("inference.GRPCInferenceService", "SystemSharedMemoryRegister CudaSharedMemoryRegister", READ),
    ("inference.GRPCInferenceService", "SystemSharedMemoryUnregister CudaSharedMemoryUnregister", READ),
    ("inference.GRPCInferenceService", "ModelInfer ModelStreamInfer", ACT),
    ("inference.GRPCInferenceService", "RepositoryModelLoad RepositoryModelUnload", ADMIN),
    ("grpc.health.v1.Health", "*", OPEN),
    ("grpc.reflection.v1.ServerReflection", "*", READ),
    ("grpc.reflection.v1alpha.ServerReflection", "*", READ),
];

/// HTTP method, routes as they are registered and their requirement. `HEAD` counts as `GET`.
const REST: &[(&str, &str, Requirement)] = &[
    ("GET", "/livez /readyz /openapi.json /docs /docs/{file} /v2/health/live /v2/health/ready", OPEN),
    // The dashboard has no data of its own; its requests have the key of its reader.
    ("GET", "/ /ui/{file}", OPEN),
    ("GET", "/metrics", READ),
    ("GET", "/v1/server/budget", READ),
    ("PUT", "/v1/server/budget", ADMIN),
    ("POST", "/v1/act /v1/encode /v1/decide /v1/sessions", ACT),
    ("GET", "/v1/sessions /v1/sessions/{id}", READ),
    ("DELETE", "/v1/sessions/{id}", ACT),
    ("GET", "/v1/environments /v1/environments/{id}", READ),
    ("POST", "/v1/environments /v1/environments/{id}/reset /v1/environments/{id}/step", ACT),
    ("DELETE", "/v1/environments/{id}", ACT),
    ("GET", "/v1/manifest", READ),
    ("GET", "/v1/policies /v1/policies/{policy} /v1/policies/{policy}/export", READ),
    ("GET", "/v1/policies/{name}/aliases /v1/policies/{name}/history /v1/policies/{name}/versions", READ),
    ("DELETE", "/v1/policies/{policy} /v1/policies/{name}/versions/{version}", ADMIN),
    ("POST", "/v1/policies/{name}/versions /v1/policies/{policy}/load /v1/policies/{policy}/unload", ADMIN),
    ("PUT", "/v1/policies/{name}/aliases/{alias}", ADMIN),
    ("DELETE", "/v1/policies/{name}/aliases/{alias}", ADMIN),
    ("GET", "/v1/jobs /v1/jobs/{id} /v1/jobs/{id}/metrics /v1/jobs/{id}/checkpoints /v1/jobs/{id}/logs", READ),
    ("GET", "/v1/jobs/{id}/events /v1/jobs/{id}/result /v1/jobs/{id}/logs/events /v1/checkpoints/{id}", READ),
    ("POST", "/v1/jobs /v1/jobs/{id}/cancel /v1/jobs/{id}/pause /v1/jobs/{id}/resume /v1/jobs/{id}/retry", JOBS),
    ("POST", "/v1/jobs/{id}/continue", JOBS),
    ("PATCH", "/v1/jobs/{id}", JOBS),
    ("DELETE", "/v1/jobs/{id}", JOBS),
    ("GET", "/v2 /v2/models/{model} /v2/models/{model}/ready /v2/models/{model}/config", READ),
    ("GET", "/v2/models/{model}/versions/{version} /v2/models/{model}/versions/{version}/ready", READ),
    ("GET", "/v2/models/{model}/versions/{version}/config", READ),
    ("POST", "/v2/models/{model}/infer /v2/models/{model}/versions/{version}/infer", ACT),
    ("GET", "/v2/models/stats /v2/models/{model}/stats /v2/models/{model}/versions/{version}/stats", READ),
    ("GET", "/v2/trace/setting /v2/models/{model}/trace/setting /v2/logging", READ),
    ("POST", "/v2/trace/setting /v2/models/{model}/trace/setting /v2/logging", READ),
    ("GET", "/v2/systemsharedmemory/status /v2/systemsharedmemory/region/{name}/status", READ),
    ("GET", "/v2/cudasharedmemory/status /v2/cudasharedmemory/region/{name}/status", READ),
    ("POST", "/v2/systemsharedmemory/region/{name}/register /v2/systemsharedmemory/region/{name}/unregister", READ),
    ("POST", "/v2/cudasharedmemory/region/{name}/register /v2/cudasharedmemory/region/{name}/unregister", READ),
    ("POST", "/v2/systemsharedmemory/unregister /v2/cudasharedmemory/unregister", READ),
    ("POST", "/v2/repository/index", READ),
    ("POST", "/v2/repository/models/{model}/load /v2/repository/models/{model}/unload", ADMIN),
];

/// What is not listed.
const UNLISTED: Requirement = ADMIN;

/// The requirement of the gRPC method at `/SERVICE/METHOD`.
pub fn grpc_requirement(path: &str) -> Requirement {
    grpc_rule(path).unwrap_or(UNLISTED)
}

/// The requirement of an HTTP method on a registered route; no route: the path is unknown.
pub fn rest_requirement(method: &Method, route: Option<&str>) -> Requirement {
    route.map_or(Requirement::AnyKey, |route| rest_rule(method, route).unwrap_or(UNLISTED))
}

/// Whether a gRPC call may wait for others: all calls may, except acting and probes. Workers may wait as well.
pub fn grpc_may_wait(path: &str) -> bool {
    path.starts_with("/qedgix.v1.WorkerService/") || may_wait(grpc_rule(path))
}

/// Whether a request to a registered route may wait for others: all may, except acting and probes.
pub fn rest_may_wait(method: &Method, route: Option<&str>) -> bool {
    may_wait(route.and_then(|route| rest_rule(method, route)))
}

fn may_wait(rule: Option<Requirement>) -> bool {
    !matches!(rule, Some(ACT | OPEN) | None)
}

/// The requirement of a gRPC method, if it is listed.
pub fn grpc_rule(path: &str) -> Option<Requirement> {
    static RULES: LazyLock<HashMap<String, Requirement>> = LazyLock::new(|| {
        let rules =
            GRPC.iter().flat_map(|(service, methods, requirement)| methods.split(' ').map(move |m| (service, m, requirement)));
        // `*` becomes a rule for the name of the service.
        rules.map(|(s, m, requirement)| (if m == "*" { format!("/{s}") } else { format!("/{s}/{m}") }, *requirement)).collect()
    });
    RULES.get(path).or_else(|| RULES.get(path.rsplit_once('/')?.0)).copied()
}

/// The requirement of an HTTP method on a route, if it is listed.
pub fn rest_rule(method: &Method, route: &str) -> Option<Requirement> {
    static RULES: LazyLock<HashMap<&str, Vec<(&str, Requirement)>>> = LazyLock::new(|| {
        let mut rules = HashMap::<_, Vec<_>>::new();
        for (method, routes, requirement) in REST {
            routes.split(' ').for_each(|route| rules.entry(route).or_default().push((*method, *requirement)));
        }
        rules
    });
    let method = if *method == Method::HEAD { "GET" } else { method.as_str() };
    RULES.get(route)?.iter().find(|rule| rule.0 == method).map(|rule| rule.1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unlisted_methods_and_routes_require_admin() {
        assert_eq!(grpc_requirement("/qedgix.v1.PolicyService/Act"), ACT);
        assert_eq!(grpc_requirement("/qedgix.v1.WorkerService/Fetch"), OPEN);
        assert_eq!(rest_requirement(&Method::HEAD, Some("/v1/jobs/{id}")), READ);
        assert_eq!(rest_requirement(&Method::GET, None), Requirement::AnyKey);
        for path in ["/qedgix.v1.PolicyService/Forget", "/qedgix.v1.PolicyService/", "/qedgix.v1.PolicyService", "/", "", "Act"] {
            assert_eq!(grpc_requirement(path), ADMIN, "{path}");
        }
        assert_eq!(rest_requirement(&Method::DELETE, Some("/v1/act")), ADMIN);
        assert_eq!(rest_requirement(&Method::GET, Some("/v1/secrets")), ADMIN);
    }

    #[test]
    fn every_method_is_documented() {
        let document = include_str!("../../docs/security.md");
        let row = |scope: Scope| {
            let start = format!("| `{}` |", scope.name());
            document.lines().find(|line| line.starts_with(&start)).unwrap_or_else(|| panic!("no row {start}"))
        };
        let of_inference = |service: &str| service.starts_with("inference.") || service.starts_with("grpc.");
        for (service, methods, requirement) in GRPC {
            let Requirement::Scope(scope) = requirement else { continue };
            // The table has the metadata of models and reflection in words.
            if of_inference(service) && *requirement == READ {
                continue;
            }
            for method in methods.split(' ') {
                assert!(row(*scope).contains(&format!("`{method}`")), "{scope:?} lacks {method}");
            }
        }
        // And names nothing that requires another scope.
        for scope in [Scope::Read, Scope::Act, Scope::Jobs, Scope::Admin] {
            for method in row(scope).split('`').skip(1).step_by(2).filter(|word| word.starts_with(char::is_uppercase)) {
                let mut rules = GRPC.iter().filter(|(_, methods, _)| methods.split(' ').any(|m| m == method)).peekable();
                assert!(rules.peek().is_some(), "{method} does not exist");
                assert!(rules.all(|(_, _, requirement)| *requirement == Requirement::Scope(scope)), "{method} as {scope:?}");
            }
        }
    }

    #[test]
    fn no_method_or_route_is_listed_twice() {
        for table in [GRPC, REST] {
            let mut all: Vec<_> =
                table.iter().flat_map(|(first, rest, _)| rest.split(' ').map(move |name| (*first, name))).collect();
            let listed = all.len();
            all.sort_unstable();
            all.dedup();
            assert_eq!(all.len(), listed);
        }
    }
}
