//! The OpenAPI document. Paths, parameters and bodies are derived from the handlers and their types; this file owns what is common
//! to all operations, the responses that are problems, and the links between operations.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use serde_json::{Map, Value, json};
use utoipa::openapi::header::HeaderBuilder;
use utoipa::openapi::security::{ApiKey, ApiKeyValue, HttpAuthScheme, HttpBuilder, SecurityRequirement, SecurityScheme};
use utoipa::openapi::{Content, OpenApi, Ref, RefOr, Response, ResponseBuilder};
use utoipa::{IntoResponses, OpenApi as _};

use crate::api::errors::Problem;
use crate::policy::baselines;

/// The document without paths, to which routers add theirs.
#[derive(utoipa::OpenApi)]
#[openapi(
    info(
        title = "Qedgix",
        description = "Serves and trains policies that steer fleets of UAVs to keep data fresh (Age of Information).\n\n\
            Every error is a problem of RFC 9457 with a stable `code`. Every response has an `x-request-id`; it is \
            that of the request, if set. Unknown fields are errors, in bodies and queries of `/v1`. gRPC serves the same use cases as \
            `qedgix.v1`. `/v2` serves the Open Inference Protocol, which has a document of its own."
    ),
    tags(
        (name = "act", description = "Headings for the UAVs of one fleet in one slot."),
        (name = "sessions", description = "Fleets whose recurrent state the server keeps."),
        (name = "policies", description = "Versions, aliases and checkpoints of policies."),
        (name = "environments", description = "Hosted environments for external learners."),
        (name = "jobs", description = "Training jobs, run by worker processes."),
        (name = "operations", description = "Probes, metrics, the OpenAPI document."),
    ),
    components(schemas(Problem)),
)]
struct Common;

/// The document without paths.
pub(super) fn document() -> OpenApi {
    let mut document = Common::openapi();
    let components = document.components.get_or_insert_default();
    let bearer = HttpBuilder::new().scheme(HttpAuthScheme::Bearer).description(Some("An API key."));
    components.responses.extend(problems().map(|(name, response)| (name.to_owned(), response.into())));
    components.add_security_scheme("bearer", SecurityScheme::Http(bearer.build()));
    let key = ApiKeyValue::with_description("x-api-key", "The same API key, in a header of its own.");
    components.add_security_scheme("api_key", SecurityScheme::ApiKey(ApiKey::Header(key)));
    // A server without API keys requires no authentication.
    let none = SecurityRequirement::default();
    let [bearer, key] = ["bearer", "api_key"].map(|scheme| SecurityRequirement::new::<_, [&str; 0], &str>(scheme, []));
    document.security = Some(vec![none, bearer, key]);
    document
}

/// The document as it is served, and the list of its operations.
#[derive(Clone)]
pub(super) struct Description {
    /// JSON.
    pub document: Bytes,
    /// `GET /v1/jobs`, ...
    pub operations: Arc<[String]>,
}

impl Description {
    /// The description of all routes, on a server with this CPU budget for jobs.
    pub(super) fn new(document: &OpenApi, cpu_budget: usize) -> Self {
        let document = finished(document, cpu_budget);
        let paths = document["paths"].as_object().into_iter().flatten();
        let operations = paths.flat_map(|(path, item)| {
            let verbs = item.as_object().into_iter().flat_map(Map::keys);
            verbs.map(move |verb| format!("{} {path}", verb.to_uppercase()))
        });
        Self { operations: operations.collect(), document: document.to_string().into() }
    }
}

/// The document with the responses and links of every operation, and the limits of this server.
fn finished(document: &OpenApi, cpu_budget: usize) -> Value {
    let mut document = serde_json::to_value(document).expect("the document is plain data");
    let everywhere = [
        Unauthorized::responses(),
        Forbidden::responses(),
        TooMany::responses(),
        Fault::responses(),
        InsufficientStorage::responses(),
    ];
    let everywhere: BTreeMap<_, _> = everywhere.into_iter().flatten().collect();
    // A replica refuses changes.
    let of_changes: BTreeMap<_, _> = Conflict::responses().into_iter().chain(everywhere.clone()).collect();
    let paths = document["paths"].as_object_mut().into_iter().flatten().filter(|(path, _)| path.starts_with("/v1"));
    for (verb, operation) in paths.filter_map(|(_, item)| item.as_object_mut()).flatten() {
        let Some(responses) = operation["responses"].as_object_mut() else { continue };
        for (status, response) in if verb == "get" { &everywhere } else { &of_changes } {
            responses.entry(status).or_insert_with(|| json!(response));
        }
    }
    let schemas = &mut document["components"]["schemas"];
    schemas["JobRequest"]["properties"]["threads"]["maximum"] = cpu_budget.into();
    let taken = json!({"enum": baselines::LIST.iter().map(|baseline| baseline.name).collect::<Vec<_>>()});
    schemas["JobRequest"]["properties"]["name"]["not"] = taken.clone();
    let requires =
        |one: &str, other: &str| json!({"required": [one], "properties": {one: {"type": "object"}, other: {"type": "null"}}});
    schemas["ActRequest"]["oneOf"] = json!([requires("graph", "scene"), requires("scene", "graph")]);
    schemas["ActRequest"]["anyOf"] =
        json!(["session_id", "recurrent_state"].map(|none| json!({"properties": {none: {"type": "null"}}})));
    document["paths"]["/v1/policies/{name}/versions"]["post"]["parameters"][0]["schema"]["not"] = taken;
    for link in &LINKS {
        link.add(&mut document);
    }
    integers(&mut document);
    document
}

/// Operations that take a value of another operation's response as a path parameter.
struct Link {
    /// Path, method and status of the response.
    response: (&'static str, &'static str, &'static str),
    /// Name of the parameter, and place of the value in the response.
    parameter: (&'static str, &'static str),
    operations: &'static [&'static str],
}

const LINKS: [Link; 6] = [
    Link {
        response: ("/v1/sessions", "post", "201"),
        parameter: ("id", "$response.body#/session_id"),
        operations: &["getSession", "closeSession"],
    },
    Link {
        response: ("/v1/environments", "post", "201"),
        parameter: ("id", "$response.body#/environment_id"),
        operations: &["getEnvironment", "resetEnvironment", "stepEnvironment", "deleteEnvironment"],
    },
    Link {
        response: ("/v1/jobs", "post", "201"),
        parameter: ("id", "$response.body#/id"),
        operations: &[
            "getJob",
            "pauseJob",
            "resumeJob",
            "retryJob",
            "cancelJob",
            "deleteJob",
            "listJobMetrics",
            "listCheckpoints",
            "listJobLogs",
        ],
    },
    Link {
        response: ("/v1/jobs/{id}/checkpoints", "get", "200"),
        parameter: ("id", "$response.body#/checkpoints/0/id"),
        operations: &["getCheckpoint"],
    },
    Link {
        response: ("/v1/policies/{name}/versions", "post", "201"),
        parameter: ("policy", "$response.body#/ref/name"),
        operations: &["getPolicy", "exportPolicy", "unloadPolicy", "loadPolicy"],
    },
    Link {
        response: ("/v1/policies/{name}/versions", "post", "201"),
        parameter: ("name", "$response.body#/ref/name"),
        operations: &["setAlias", "listAliases", "listAliasMoves"],
    },
];

impl Link {
    fn add(&self, document: &mut Value) {
        let (path, verb, status) = self.response;
        let (parameter, source) = self.parameter;
        let link = |id: &&str| ((*id).to_owned(), json!({"operationId": id, "parameters": {parameter: source}}));
        let links = &mut document["paths"][path][verb]["responses"][status]["links"];
        if links.is_null() {
            *links = json!({});
        }
        links.as_object_mut().expect("an object, made above").extend(self.operations.iter().map(link));
    }
}

/// Formats int32 and int64 are signed; unsigned integers have bounds instead.
fn integers(schema: &mut Value) {
    match schema {
        Value::Object(fields) => {
            let bits = fields.get("format").and_then(Value::as_str).and_then(|format| format.strip_prefix("int"));
            let unsigned = fields.get("minimum").and_then(Value::as_f64).is_some_and(|minimum| minimum >= 0.0);
            if let Some(bits) = bits.filter(|_| unsigned) {
                let most = if bits == "32" { u64::from(u32::MAX) } else { u64::MAX };
                fields.entry("maximum").or_insert_with(|| most.into());
                fields.remove("format");
            }
            fields.values_mut().for_each(integers);
        }
        Value::Array(items) => items.iter_mut().for_each(integers),
        _ => {}
    }
}

/// Responses that are problems: each a type to list among the responses of an operation, and a component of the document.
macro_rules! problems {
    ($($name:ident = $status:literal $(with $header:literal)? : $text:literal;)+) => {
        $(
            #[doc = $text]
            pub(super) struct $name;

            impl IntoResponses for $name {
                fn responses() -> BTreeMap<String, RefOr<Response>> {
                    BTreeMap::from([(stringify!($status).to_owned(), Ref::from_response_name(stringify!($name)).into())])
                }
            }
        )+

        fn problems() -> [(&'static str, Response); [$($status),+].len()] {
            [$((stringify!($name), problem($text)$(.header($header, HeaderBuilder::new().build()))?.build())),+]
        }
    };
}

problems! {
    BadRequest = 400: "Malformed or inconsistent input; `field` is the path of the invalid field, if there is one.";
    Unauthorized = 401: "The server requires an API key, and the request has none or an invalid one.";
    Forbidden = 403: "The API key lacks the required scope.";
    NotFound = 404: "The resource does not exist.";
    Conflict = 409: "The state of the resource does not allow the operation, the resource exists and differs, or the server is a replica; see `code`.";
    TooLarge = 413: "The body is larger than the limit.";
    UnsupportedMediaType = 415: "The content type of the body is not supported.";
    Unprocessable = 422: "The JSON does not match the schema; `field` is the path.";
    TooMany = 429 with "retry-after": "A limit is reached; retry later.";
    Fault = 500: "An internal error of the server.";
    Draining = 503 with "retry-after": "The server is shutting down or not ready; retry later.";
    InsufficientStorage = 507 with "retry-after": "The database cannot be written, and nothing was stored; retry later.";
}

/// The problems of a JSON body.
pub(super) struct BadBody;

impl IntoResponses for BadBody {
    fn responses() -> BTreeMap<String, RefOr<Response>> {
        let all = [BadRequest::responses(), TooLarge::responses(), UnsupportedMediaType::responses(), Unprocessable::responses()];
        all.into_iter().flatten().collect()
    }
}

fn problem(description: &str) -> ResponseBuilder {
    let content = Content::new(Some(Ref::from_schema_name("Problem")));
    ResponseBuilder::new().description(description).content("application/problem+json", content)
}
