//! JSON schemas of domain types that REST sends and accepts as they are stored: configurations and enums of strings.

use serde_json::{Map, Value, json};
use utoipa::openapi::RefOr;
use utoipa::openapi::schema::Schema;
use utoipa::{PartialSchema, ToSchema};

use crate::env::{Boundary, EnvConfig};
use crate::policy::mixer::MixerKind;
use crate::policy::{Advice, Aggregation, Identity, Memory, ObservationKind};
use crate::store::{AttemptOutcome, CheckpointKind, JobState, PendingAction};
use crate::train_config::{Algorithm, Preset, Training};

/// A schema written as JSON.
pub(super) fn schema(document: Value) -> RefOr<Schema> {
    serde_json::from_value(document).expect("a literal of this program is a schema")
}

/// A field of an object: name, schema, description.
type Field = (&'static str, Value, &'static str);

/// An object with these fields only, and the defaults of the fields that have one.
fn object(fields: &[Field], defaults: &Value) -> Map<String, Value> {
    let field = |(name, schema, description): &Field| {
        let mut schema = schema.clone();
        schema["description"] = (*description).into();
        if let Some(default) = defaults.get(name) {
            schema["default"] = default.clone();
        }
        ((*name).to_owned(), schema)
    };
    let properties: Map<String, Value> = fields.iter().map(field).collect();
    Map::from_iter([
        ("type".to_owned(), "object".into()),
        ("properties".to_owned(), properties.into()),
        ("additionalProperties".to_owned(), false.into()),
    ])
}

fn integer(minimum: u64, maximum: u64) -> Value {
    json!({"type": "integer", "minimum": minimum, "maximum": maximum})
}

fn number(minimum: f64, maximum: f64) -> Value {
    json!({"type": "number", "minimum": minimum, "maximum": maximum})
}

fn boolean() -> Value {
    json!({"type": "boolean"})
}

/// An object with these fields only.
fn plain_object(fields: &[(&str, Value)], required: &[&str]) -> Value {
    let properties: Map<String, Value> = fields.iter().map(|(name, schema)| ((*name).to_owned(), schema.clone())).collect();
    json!({"type": "object", "properties": properties, "required": required, "additionalProperties": false})
}

/// An object with these fields only, or null.
fn nullable_object(fields: &[(&str, Value)], required: &[&str]) -> Value {
    let mut schema = plain_object(fields, required);
    schema["type"] = json!(["object", "null"]);
    schema
}

/// One of `words`, or `{"given": [[x, y], ...]}`.
fn words_or_points(words: &[&str]) -> Value {
    let point = json!({"type": "array", "items": number(0.0, 1.0), "minItems": 2, "maxItems": 2});
    let given = json!({
        "type": "object", "required": ["given"], "additionalProperties": false,
        "properties": {"given": {"type": "array", "items": point}}
    });
    json!({"oneOf": [{"type": "string", "enum": words}, given]})
}

/// A boundary, or null.
pub(super) fn optional_boundary() -> RefOr<Schema> {
    let mut words = string_enum::<Boundary>();
    words["type"] = json!(["string", "null"]);
    schema(words)
}

impl PartialSchema for EnvConfig {
    fn schema() -> RefOr<Schema> {
        let defaults = serde_json::to_value(Self::default()).expect("a configuration is plain data");
        let fields = [
            ("uavs", integer(1, 4096), "M, the number of UAVs."),
            ("users", integer(1, 65_536), "N, the number of users."),
            ("slots", integer(1, 10_000), "K, slots per episode."),
            ("speed", number(0.0, 1.0), "v, distance that a UAV moves per slot, in units of the square's side."),
            ("transmission_range", number(0.0, 2.0), "t, range within which a UAV collects the data of a user."),
            ("detection_range", number(1e-6, 2.0), "d, range within which nodes detect each other; at least t."),
            (
                "communication_range",
                json!({"type": ["number", "null"], "minimum": 0.0, "maximum": 10.0}),
                "Range within which UAVs exchange messages and learn each other's positions; absent: d.",
            ),
            ("hover", boolean(), "Adds a ninth heading, which stays in place."),
            ("boundary", string_enum::<Boundary>(), "Whether UAVs are kept in the unit square."),
            (
                "reward_scale",
                json!({"type": ["number", "null"], "minimum": 1e-9, "maximum": 1e9}),
                "Factor of the reward, which is -reward_scale * mean AoI; absent: 1/K.",
            ),
            ("start", words_or_points(&["center", "random"]), "Positions of UAVs in slot 0."),
            ("layout", words_or_points(&["random"]), "Positions of users in slot 0."),
            (
                "weights",
                json!({"type": ["array", "null"], "items": number(0.0, 1e6)}),
                "Weight of each user in the reward and the mean AoI, scaled to mean 1; absent: all equal.",
            ),
            ("user_speed", number(0.0, 1.0), "Distance that a user walks per slot; 0: users stay in place."),
            (
                "lose_uav",
                nullable_object(&[("uav", integer(0, 4095)), ("slot", integer(0, 9999))], &["uav", "slot"]),
                "A UAV that is lost from a slot on: it is not in observations, and its actions have no effect. Not for training.",
            ),
            (
                "user_slots",
                json!({"type": "array", "items": plain_object(&[
                    ("user", integer(0, 65_535)), ("from", integer(0, 10_000)),
                    ("until", json!({"type": ["integer", "null"], "minimum": 0, "maximum": 10_000})),
                ], &["user"])}),
                "The slots of users that come and go: from, and until (exclusive). All other users are always there. Not for training.",
            ),
        ];
        schema(object(&fields, &defaults).into())
    }
}

impl ToSchema for EnvConfig {
    fn name() -> std::borrow::Cow<'static, str> {
        "Environment".into()
    }
}

/// The fields of a training configuration.
fn training() -> Map<String, Value> {
    const STEPS: u64 = 1_000_000_000_000;
    let fields = [
        ("observation", string_enum::<ObservationKind>(), "Observation of every node."),
        ("identity", string_enum::<Identity>(), "Identity of a UAV."),
        ("aggregation", string_enum::<Aggregation>(), "Aggregation of EdgeConv."),
        ("layers", integer(1, 8), "Graph layers."),
        ("self_position", boolean(), "Whether a UAV observes its own position."),
        ("self_loops", boolean(), "Whether a node is its own neighbour."),
        ("hops", integer(1, 9), "Links over which a UAV without a graph network observes; L + 1 reach as far as L graph layers."),
        ("normalise", boolean(), "Whether flat observations divide relative positions by d and scale own positions to [-1, 1]."),
        (
            "memory",
            string_enum::<Memory>(),
            "What a UAV remembers: the users it detected and the ground it searched; shared: exchanged within the communication range.",
        ),
        (
            "advice",
            string_enum::<Advice>(),
            "What a rule tells a UAV in every slot, from its memory; sweep: the heading that the rule `sweep` would fly.",
        ),
        (
            "advice_margin",
            number(0.0, 1e3),
            "How much higher the Q-value of another heading than the advised one must be, per remembered user and UAV, at least once.",
        ),
        ("mixer", string_enum::<MixerKind>(), "Mixer of the UAVs' values."),
        ("hyper_init", number(0.0, 10.0), "Factor of the initial weights of the hypernetworks' last layers."),
        ("steps", integer(1, STEPS), "Environment steps (slots) to train for."),
        ("learning_rate", number(1e-12, 1.0), "Adam's learning rate at the beginning."),
        (
            "learning_rate_decay",
            number(0.0, 1.0),
            "Share of the learning rate that is left at the end, after a linear decay over `steps`.",
        ),
        ("gamma", number(0.0, 1.0), "Discount."),
        ("lambda", number(0.0, 1.0), "Lambda of TD(lambda)."),
        ("clip", number(1e-9, 1e9), "Global L2 norm that gradients are clipped to."),
        ("epsilon_end", number(0.0, 1.0), "Exploration rate at the end."),
        ("epsilon_anneal", integer(1, STEPS), "Environment steps over which the exploration rate falls from 1 to `epsilon_end`."),
        ("batch", integer(1, 4096), "Episodes per update."),
        ("updates_per_iteration", integer(1, 1024), "Updates per iteration; an iteration collects `envs` episodes."),
        ("envs", integer(1, 4096), "Episodes collected together."),
        ("buffer", integer(1, 1_000_000), "Episodes in the replay buffer; at least `batch`."),
        ("target_every", integer(1, 1_000_000_000), "Episodes between copies of the networks to the target networks."),
        (
            "target_tau",
            number(0.0, 1.0),
            "Share of the networks that every update mixes into the target networks; 0: copies instead.",
        ),
        (
            "average",
            integer(0, 1_000_000_000),
            "Updates over which the evaluated and published weights are averaged; 0 or 1: no average.",
        ),
        ("shaping", boolean(), "Whether potential-based shaping rewards the collected age; optimal policies stay the same."),
        ("augment", boolean(), "Whether replayed episodes are rotated and mirrored at random."),
        (
            "teacher",
            json!({"type": ["string", "null"]}),
            "Baseline that flies some of the UAVs while episodes are collected; null or `none`: no teacher.",
        ),
        ("teacher_share", number(0.0, 1.0), "Smallest probability that the teacher flies a UAV for an episode."),
        ("vary", vary(), "Ranges [lowest, highest] from which environments are drawn, one per iteration; absent: not drawn."),
        ("eval_every", integer(1, STEPS), "Environment steps between evaluations."),
        ("eval_episodes", integer(1, 4096), "Layouts per evaluation."),
    ];
    object(&fields, &Value::Null)
}

/// The ranges of varied environments.
fn vary() -> Value {
    let range = |end: Value| json!({"type": ["array", "null"], "items": end, "minItems": 2, "maxItems": 2});
    json!({
        "type": "object",
        "properties": {
            "uavs": range(integer(1, 4096)),
            "users": range(integer(1, 65_536)),
            "slots": range(integer(1, 10_000)),
            "transmission_range": range(number(0.0, 2.0)),
            "detection_range": range(number(1e-6, 2.0)),
            "communication_range": range(number(0.0, 10.0)),
        },
        "additionalProperties": false,
    })
}

impl PartialSchema for Training {
    fn schema() -> RefOr<Schema> {
        let mut object = training();
        let names: Value = object["properties"].as_object().into_iter().flat_map(Map::keys).cloned().collect();
        object.insert("required".into(), names);
        schema(object.into())
    }
}

impl ToSchema for Training {}

/// A training configuration with none of its fields required, or null.
pub(super) fn partial_training() -> RefOr<Schema> {
    schema(json!({"oneOf": [training(), {"type": "null"}]}))
}

/// An enum whose values are JSON strings.
trait StringEnum {
    fn values() -> Value;
}

fn string_enum<T: StringEnum>() -> Value {
    json!({"type": "string", "enum": T::values()})
}

/// A variant that is missing here does not compile.
macro_rules! string_enums {
    ($($type:ident { $($variant:ident)+ })+) => {$(
        impl StringEnum for $type {
            fn values() -> Value {
                let _every_variant = |value: $type| match value { $($type::$variant)|+ => () };
                json!([$($type::$variant),+])
            }
        }

        impl PartialSchema for $type {
            fn schema() -> RefOr<Schema> {
                schema(string_enum::<Self>())
            }
        }

        impl ToSchema for $type {}
    )+};
}

string_enums! {
    Algorithm { Qmix Vdn Iql Qedgix Agggnn Rgcn }
    Preset { Paper Authors Practical }
    MixerKind { Qmix Invariant Vdn None }
    Memory { None Own Shared }
    Advice { None Sweep }
    ObservationKind { Flat Set }
    Identity { Onehot Phase Token None }
    Aggregation { Mean Sum }
    Boundary { Clamp Free }
    JobState { Queued Running Paused Cancelled Succeeded Failed }
    PendingAction { Cancel Pause }
    CheckpointKind { Best Last }
    AttemptOutcome { Succeeded Failed Cancelled Paused Interrupted }
}
