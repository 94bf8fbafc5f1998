//! Who may do what: one table for both transports, and the gate that asks it. What is not in the table needs `admin`.

use std::collections::HashMap;
use std::sync::LazyLock;

use axum::extract::Request;
use axum::http::{HeaderMap, HeaderName, Method, header};

use crate::service::keys::{Caller, Scope};
use crate::service::{App, Error};

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
    ("inference.GRPCInferenceService", "ModelStatistics RepositoryIndex", READ),
    ("inference.GRPCInferenceService", "ModelInfer ModelStreamInfer", ACT),
    ("inference.GRPCInferenceService", "RepositoryModelLoad RepositoryModelUnload", ADMIN),
    ("grpc.health.v1.Health", "*", OPEN),
    ("grpc.reflection.v1.ServerReflection", "*", READ),
    ("grpc.reflection.v1alpha.ServerReflection", "*", READ),
];

/// Verb, routes as they are registered, what they need. `HEAD` is `GET`.
const REST: &[(&str, &str, Need)] = &[
    ("GET", "/livez /readyz /openapi.json /docs /docs/ /docs/{*path} /v2/health/live", OPEN),
    ("GET", "/ /metrics", READ),
    ("POST", "/v1/act /v1/sessions", ACT),
    ("GET", "/v1/sessions /v1/sessions/{id}", READ),
    ("DELETE", "/v1/sessions/{id}", ACT),
    ("GET", "/v1/environments /v1/environments/{id}", READ),
    ("POST", "/v1/environments /v1/environments/{id}/reset /v1/environments/{id}/step", ACT),
    ("DELETE", "/v1/environments/{id}", ACT),
    ("GET", "/v1/policies /v1/policies/{policy} /v1/policies/{name}/versions /v1/policies/{name}/aliases", READ),
    ("GET", "/v1/policies/{name}/history /v1/policies/{name}/export", READ),
    ("POST", "/v1/policies /v1/policies/{name}/versions /v1/policies/{name}/load /v1/policies/{name}/unload", ADMIN),
    ("PUT", "/v1/policies/{name}/aliases/{alias}", ADMIN),
    ("DELETE", "/v1/policies/{policy} /v1/policies/{name}/aliases/{alias}", ADMIN),
    ("GET", "/v1/jobs /v1/jobs/{id} /v1/jobs/{id}/metrics /v1/jobs/{id}/checkpoints /v1/jobs/{id}/logs", READ),
    ("GET", "/v1/jobs/{id}/events /v1/checkpoints/{id}", READ),
    ("POST", "/v1/jobs /v1/jobs/{id}/cancel /v1/jobs/{id}/pause /v1/jobs/{id}/resume", JOBS),
    ("DELETE", "/v1/jobs/{id}", JOBS),
    ("GET", "/v2 /v2/health/ready /v2/models/{model} /v2/models/{model}/ready /v2/models/{model}/config", READ),
    ("GET", "/v2/models/{model}/stats /v2/models/{model}/versions/{version}", READ),
    ("GET", "/v2/models/{model}/versions/{version}/ready /v2/models/{model}/versions/{version}/config", READ),
    ("POST", "/v2/models/{model}/infer /v2/models/{model}/versions/{version}/infer", ACT),
    ("POST", "/v2/repository/index", READ),
    ("POST", "/v2/repository/models/{model}/load /v2/repository/models/{model}/unload", ADMIN),
];

/// Whether a method is in the table, and what it needs.
#[derive(Clone, Copy, Debug)]
pub struct Rule {
    /// False: nobody said what it needs.
    pub listed: bool,
    /// What it needs.
    pub need: Need,
}

impl Rule {
    fn of(found: Option<&Need>) -> Self {
        Self { listed: found.is_some(), need: found.copied().unwrap_or(ADMIN) }
    }
}

/// The rule of a gRPC method, `SERVICE/METHOD`.
pub fn grpc(method: &str) -> Rule {
    static RULES: LazyLock<HashMap<String, Need>> = LazyLock::new(|| {
        let rules = GRPC.iter().flat_map(|(service, methods, need)| methods.split(' ').map(move |m| (service, m, need)));
        // A whole service goes by its name alone.
        rules.map(|(s, m, need)| (if m == "*" { (*s).to_owned() } else { format!("{s}/{m}") }, *need)).collect()
    });
    let service = || RULES.get(method.split_once('/')?.0);
    Rule::of(RULES.get(method).or_else(service))
}

/// The rule of a verb on a route, as it was registered; without a route there is nothing at this path.
pub fn rest(verb: &Method, route: Option<&str>) -> Rule {
    static RULES: LazyLock<HashMap<&str, Vec<(&str, Need)>>> = LazyLock::new(|| {
        let mut rules = HashMap::<_, Vec<_>>::new();
        for (verb, routes, need) in REST {
            routes.split(' ').for_each(|route| rules.entry(route).or_default().push((*verb, *need)));
        }
        rules
    });
    let Some(route) = route else { return Rule { listed: false, need: Need::Key } };
    let verb = if *verb == Method::HEAD { "GET" } else { verb.as_str() };
    Rule::of(RULES.get(route).and_then(|rules| rules.iter().find(|rule| rule.0 == verb)).map(|rule| &rule.1))
}

/// A request that is not let in.
pub(super) struct Refusal {
    /// [`Error::Unauthenticated`], [`Error::PermissionDenied`] or [`Error::Busy`].
    pub(super) error: Error,
    /// Whether the table has what it asks for; otherwise its name is made up and no label.
    pub(super) listed: bool,
}

/// Lets a request in, or not. Who asks is put into its extensions; the secret is taken out of its headers.
pub(super) fn admit(app: &App, request: &mut Request, rule: impl FnOnce() -> Rule) -> Result<(), Refusal> {
    // All that it costs where nobody needs a key.
    if !app.keys.required() {
        return Ok(());
    }
    let Rule { listed, need } = rule();
    check(app, need, request).map_err(|error| Refusal { error, listed })
}

fn check(app: &App, need: Need, request: &mut Request) -> Result<(), Error> {
    if need == Need::Nothing {
        return Ok(());
    }
    let now = app.clock.now();
    let Some(caller) = app.keys.authenticate(presented(request.headers()), now)? else { return Ok(()) };
    if let Need::Scope(scope) = need {
        caller.authorize(scope)?;
    }
    caller.spend(now)?;
    tracing::Span::current().record("key", caller.id());
    request.headers_mut().remove(header::AUTHORIZATION);
    request.headers_mut().remove(API_KEY);
    request.extensions_mut().insert::<Caller>(caller);
    Ok(())
}

const API_KEY: HeaderName = HeaderName::from_static("x-api-key");

/// The key that a request shows.
fn presented(headers: &HeaderMap) -> Option<&str> {
    let bearer = || {
        let (scheme, key) = headers.get(header::AUTHORIZATION)?.to_str().ok()?.split_once(' ')?;
        scheme.eq_ignore_ascii_case("bearer").then_some(key.trim())
    };
    bearer().or_else(|| headers.get(API_KEY)?.to_str().ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_nobody_thought_of_needs_admin() {
        assert_eq!(grpc("qedgix.v1.PolicyService/Act").need, ACT);
        assert_eq!(grpc("qedgix.v1.WorkerService/Fetch").need, OPEN);
        assert_eq!(rest(&Method::HEAD, Some("/v1/jobs/{id}")).need, READ);
        assert_eq!(rest(&Method::GET, None).need, Need::Key);
        for rule in [
            grpc("qedgix.v1.PolicyService/Forget"),
            grpc("qedgix.v1.PolicyService/"),
            grpc("qedgix.v1.PolicyService"),
            grpc(""),
            rest(&Method::DELETE, Some("/v1/act")),
            rest(&Method::GET, Some("/v1/secrets")),
        ] {
            assert!(!rule.listed && rule.need == ADMIN, "{rule:?}");
        }
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

    #[test]
    fn keys_are_found_in_both_headers() {
        let of = |pairs: &[(&str, &str)]| {
            let mut headers = HeaderMap::new();
            for (name, value) in pairs {
                headers.insert(HeaderName::try_from(*name).unwrap(), value.parse().unwrap());
            }
            presented(&headers).map(str::to_owned)
        };
        assert_eq!(of(&[("authorization", "Bearer k")]).as_deref(), Some("k"));
        assert_eq!(of(&[("authorization", "bearer  k ")]).as_deref(), Some("k"));
        assert_eq!(of(&[("x-api-key", "k")]).as_deref(), Some("k"));
        assert_eq!(of(&[("authorization", "Basic b"), ("x-api-key", "k")]).as_deref(), Some("k"));
        assert_eq!(of(&[("authorization", "Basic b")]), None);
        assert_eq!(of(&[("authorization", "k")]), None);
    }
}
