//! Who may do what: one table for both transports. What is not in it needs `admin`.

use std::collections::HashMap;
use std::sync::LazyLock;

use axum::http::Method;

use crate::service::keys::Scope;

/// What a caller has to show.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Need {
    /// Nothing: probes, documentation, and workers, who have tokens of their own.
    Nothing,
    /// Any key: there is no such thing, and only who belongs here is told.
    Key,
    /// A key with this scope.
    Scope(Scope),
}

const OPEN: Need = Need::Nothing;
const READ: Need = Need::Scope(Scope::Read);
const ACT: Need = Need::Scope(Scope::Act);
const JOBS: Need = Need::Scope(Scope::Jobs);
const ADMIN: Need = Need::Scope(Scope::Admin);

/// Service, methods (`*`: all), what they need.
const GRPC: &[(&str, &str, Need)] = &[
    ("qedgix.v1.PolicyService", "Act ActBatch ActStream OpenSession CloseSession", ACT),
    ("qedgix.v1.PolicyService", "GetSession ListSessions GetPolicy ListPolicies", READ),
    ("qedgix.v1.EnvironmentService", "CreateEnvironment Reset Step DeleteEnvironment", ACT),
    ("qedgix.v1.EnvironmentService", "GetEnvironment", READ),
    ("qedgix.v1.JobService", "SubmitJob CancelJob PauseJob ResumeJob", JOBS),
    ("qedgix.v1.JobService", "GetJob ListJobs GetJobMetrics WatchJob", READ),
    ("qedgix.v1.WorkerService", "*", OPEN),
    ("inference.GRPCInferenceService", "ServerLive", OPEN),
    ("inference.GRPCInferenceService", "ServerReady ServerMetadata ModelReady ModelMetadata ModelConfig", READ),
    ("inference.GRPCInferenceService", "RepositoryIndex", READ),
    ("inference.GRPCInferenceService", "ModelInfer ModelStreamInfer", ACT),
    ("inference.GRPCInferenceService", "RepositoryModelLoad RepositoryModelUnload", ADMIN),
    ("grpc.health.v1.Health", "*", OPEN),
    ("grpc.reflection.v1.ServerReflection", "*", READ),
    ("grpc.reflection.v1alpha.ServerReflection", "*", READ),
];

/// Verb, routes as they are registered, what they need. `HEAD` is `GET`.
const REST: &[(&str, &str, Need)] = &[
    ("GET", "/livez /readyz /openapi.json /docs /docs/{file} /v2/health/live", OPEN),
    ("GET", "/ /metrics", READ),
    ("POST", "/v1/act /v1/sessions", ACT),
    ("GET", "/v1/sessions /v1/sessions/{id}", READ),
    ("DELETE", "/v1/sessions/{id}", ACT),
    ("GET", "/v1/environments /v1/environments/{id}", READ),
    ("POST", "/v1/environments /v1/environments/{id}/reset /v1/environments/{id}/step", ACT),
    ("DELETE", "/v1/environments/{id}", ACT),
    ("GET", "/v1/policies /v1/policies/{policy} /v1/policies/{policy}/export", READ),
    ("GET", "/v1/policies/{policy}/aliases /v1/policies/{policy}/history", READ),
    ("POST", "/v1/policies/{policy}/versions /v1/policies/{policy}/load /v1/policies/{policy}/unload", ADMIN),
    ("PUT", "/v1/policies/{policy}/aliases/{alias}", ADMIN),
    ("DELETE", "/v1/policies/{policy}/aliases/{alias}", ADMIN),
    ("GET", "/v1/jobs /v1/jobs/{id} /v1/jobs/{id}/metrics /v1/jobs/{id}/checkpoints /v1/jobs/{id}/logs", READ),
    ("GET", "/v1/jobs/{id}/events /v1/checkpoints/{id}", READ),
    ("POST", "/v1/jobs /v1/jobs/{id}/cancel /v1/jobs/{id}/pause /v1/jobs/{id}/resume", JOBS),
    ("DELETE", "/v1/jobs/{id}", JOBS),
    ("GET", "/v2 /v2/health/ready /v2/models/{model} /v2/models/{model}/ready /v2/models/{model}/config", READ),
    ("GET", "/v2/models/{model}/versions/{version} /v2/models/{model}/versions/{version}/ready", READ),
    ("GET", "/v2/models/{model}/versions/{version}/config", READ),
    ("POST", "/v2/models/{model}/infer /v2/models/{model}/versions/{version}/infer", ACT),
    ("POST", "/v2/repository/index", READ),
    ("POST", "/v2/repository/models/{model}/load /v2/repository/models/{model}/unload", ADMIN),
];

/// What nobody listed.
const UNLISTED: Need = ADMIN;

/// What the gRPC method at `/SERVICE/METHOD` needs.
pub fn grpc(path: &str) -> Need {
    grpc_rule(path).unwrap_or(UNLISTED)
}

/// What a verb needs on a route, as it was registered; without a route there is nothing at this path.
pub fn rest(verb: &Method, route: Option<&str>) -> Need {
    route.map_or(Need::Key, |route| rest_rule(verb, route).unwrap_or(UNLISTED))
}

/// The rule of a gRPC method, if it is in the table.
pub fn grpc_rule(path: &str) -> Option<Need> {
    static RULES: LazyLock<HashMap<String, Need>> = LazyLock::new(|| {
        let rules = GRPC.iter().flat_map(|(service, methods, need)| methods.split(' ').map(move |m| (service, m, need)));
        // A whole service goes by its name alone.
        rules.map(|(s, m, need)| (if m == "*" { format!("/{s}") } else { format!("/{s}/{m}") }, *need)).collect()
    });
    RULES.get(path).or_else(|| RULES.get(path.rsplit_once('/')?.0)).copied()
}

/// The rule of a verb on a route, if it is in the table.
pub fn rest_rule(verb: &Method, route: &str) -> Option<Need> {
    static RULES: LazyLock<HashMap<&str, Vec<(&str, Need)>>> = LazyLock::new(|| {
        let mut rules = HashMap::<_, Vec<_>>::new();
        for (verb, routes, need) in REST {
            routes.split(' ').for_each(|route| rules.entry(route).or_default().push((*verb, *need)));
        }
        rules
    });
    let verb = if *verb == Method::HEAD { "GET" } else { verb.as_str() };
    RULES.get(route)?.iter().find(|rule| rule.0 == verb).map(|rule| rule.1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_nobody_thought_of_needs_admin() {
        assert_eq!(grpc("/qedgix.v1.PolicyService/Act"), ACT);
        assert_eq!(grpc("/qedgix.v1.WorkerService/Fetch"), OPEN);
        assert_eq!(rest(&Method::HEAD, Some("/v1/jobs/{id}")), READ);
        assert_eq!(rest(&Method::GET, None), Need::Key);
        for path in ["/qedgix.v1.PolicyService/Forget", "/qedgix.v1.PolicyService/", "/qedgix.v1.PolicyService", "/", "", "Act"] {
            assert_eq!(grpc(path), ADMIN, "{path}");
        }
        assert_eq!(rest(&Method::DELETE, Some("/v1/act")), ADMIN);
        assert_eq!(rest(&Method::GET, Some("/v1/secrets")), ADMIN);
    }

    #[test]
    fn nothing_is_listed_twice() {
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
