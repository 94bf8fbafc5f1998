//! The frame and the world of a fleet, as JSON.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::api::convert::flight::{self, FlightFields};
use crate::api::json::{self, objects_only};
use crate::env::Boundary;
use crate::invalid::Invalid;
use crate::serving::{Constraint, ConstraintOptions};

/// The area that a fleet flies in, a rectangle in the coordinates of the caller. With a frame, all coordinates, lengths and speeds of
/// requests and responses are those of the caller, for example in metres. Without one, the area is the unit square.
#[derive(Clone, Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub struct Frame {
    /// The corner of the area with the smallest coordinates along its axes. Default: (0, 0).
    origin: Option<Origin>,
    /// Side of a square area; instead of `width` and `height`.
    #[schema(minimum = 1e-6, maximum = 1e9)]
    side: Option<f64>,
    /// Length along the x axis of the area.
    #[schema(minimum = 1e-6, maximum = 1e9)]
    width: Option<f64>,
    /// Length along the y axis of the area.
    #[schema(minimum = 1e-6, maximum = 1e9)]
    height: Option<f64>,
    /// Direction of the x axis of the area, in degrees counter-clockwise from the x axis of the caller.
    #[serde(default)]
    #[schema(minimum = -360, maximum = 360)]
    rotation_deg: f64,
}

/// A position of the caller.
#[derive(Clone, Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
struct Origin {
    #[schema(minimum = -1e9, maximum = 1e9)]
    x: f64,
    #[schema(minimum = -1e9, maximum = 1e9)]
    y: f64,
}

/// The world that a fleet flies in, where it differs from that of the policy. Lengths are in units of the frame.
#[derive(Clone, Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub struct World {
    /// Duration of a slot in seconds. Default: 1, so that a speed is a distance per slot.
    #[schema(minimum = 1e-3, maximum = 1e6)]
    slot_seconds: Option<f64>,
    /// Speed of the UAVs, per second; at most a side of the square per slot.
    speed: Option<f64>,
    /// Range within which a UAV collects the data of a user; at most two sides of the square.
    transmission_range: Option<f64>,
    /// Range within which nodes detect each other; at least the transmission range, at most two sides of the square.
    detection_range: Option<f64>,
    /// Range within which UAVs exchange messages. Default: the detection range, if given.
    communication_range: Option<f64>,
    /// How far policies that plan look ahead, in slots.
    #[serde(default, deserialize_with = "json::optional_integer")]
    #[schema(minimum = 1, maximum = 10000)]
    slots: Option<u32>,
    /// What happens at the border of the area: UAVs stay in it (`clamp`, the default), or may leave it (`free`).
    #[schema(schema_with = super::config_schemas::optional_boundary)]
    boundary: Option<Boundary>,
}

/// Constraints that no heading may break. Every UAV gets the heading with the highest Q-value that keeps them (policies without
/// Q-values: the one nearest to the heading that they prefer), or hovers; separation is kept jointly. If nothing keeps all, a UAV gets
/// what breaks least, and the action says so. Requires the position of every UAV.
#[derive(Clone, Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub struct Constraints {
    /// Zones that no UAV enters.
    #[serde(default)]
    #[schema(max_items = 64)]
    no_fly: Vec<Zone>,
    /// Minimum distance between two UAVs.
    #[schema(minimum = 0, maximum = 1e9)]
    min_separation: Option<f64>,
    /// Where UAVs return to. Required by `max_distance` and `return_in_time`.
    home: Option<Origin>,
    /// Maximum distance from home.
    #[schema(minimum = 0, maximum = 1e9)]
    max_distance: Option<f64>,
    /// Whether every UAV with `endurance_seconds` flies home in time.
    #[serde(default)]
    return_in_time: bool,
}

/// A zone: a polygon with 3 to 64 corners, or a circle.
#[derive(Clone, Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
struct Zone {
    /// The corners of a polygon, in order.
    #[serde(default)]
    #[schema(max_items = 64)]
    corners: Vec<Origin>,
    /// Centre of a circle.
    center: Option<Origin>,
    /// Radius of a circle.
    #[schema(minimum = 0, maximum = 1e9)]
    radius: Option<f64>,
}

objects_only!(Frame, Origin, World, Constraints, Zone);

/// The constraints of a request.
///
/// # Errors
/// A zone that is neither a polygon nor a circle.
pub fn constraints(constraints: Constraints) -> Result<ConstraintOptions, Invalid> {
    let Constraints { no_fly, min_separation, home, max_distance, return_in_time } = constraints;
    let point = |at: Origin| [at.x, at.y];
    let zones = no_fly
        .into_iter()
        .enumerate()
        .map(|(i, of)| flight::zone(i, of.corners.into_iter().map(point).collect(), of.center.map(point), of.radius));
    let no_fly = zones.collect::<Result<_, _>>()?;
    Ok(ConstraintOptions { no_fly, min_separation, home: home.map(point), max_distance, return_in_time })
}

/// What constraints did to the heading of a UAV.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Overruled {
    /// The heading that the policy prefers.
    #[schema(maximum = 8)]
    preferred_heading_index: u8,
    /// What it would break, given the headings of the other UAVs: `no_fly`, `min_separation`, `max_distance`, `return_in_time`.
    because: Vec<&'static str>,
    /// What the heading of the action breaks: no heading keeps all constraints.
    violates: Vec<&'static str>,
}

impl From<crate::serving::Overruled> for Overruled {
    fn from(overruled: crate::serving::Overruled) -> Self {
        let list = |of: Vec<Constraint>| of.into_iter().map(Constraint::name).collect();
        let (because, violates) = (list(overruled.because), list(overruled.violates));
        Self { preferred_heading_index: overruled.preferred, because, violates }
    }
}

impl From<Frame> for flight::FrameFields {
    fn from(frame: Frame) -> Self {
        let Frame { origin, side, width, height, rotation_deg } = frame;
        Self { origin: origin.map(|origin| [origin.x, origin.y]), side, width, height, rotation_deg }
    }
}

impl From<World> for crate::serving::WorldOptions {
    fn from(world: World) -> Self {
        let World { slot_seconds, speed, transmission_range, detection_range, communication_range, slots, boundary } = world;
        let slots = slots.map(|slots| slots as usize);
        Self { slot_seconds, speed, transmission_range, detection_range, communication_range, slots, boundary }
    }
}

/// The fields of a request about its fleet.
///
/// # Errors
/// A zone that is neither a polygon nor a circle.
pub fn fields(
    frame: Option<Frame>,
    world: Option<World>,
    symmetric: Option<bool>,
    limits: Option<Constraints>,
) -> Result<FlightFields, Invalid> {
    let constraints = limits.map(constraints).transpose()?;
    Ok(FlightFields { frame: frame.map(Into::into), world: world.map(Into::into), symmetric, constraints })
}

/// Something that a caller should know about its session.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Warning {
    /// The field of the request, such as `world.speed`.
    field: &'static str,
    /// What it means.
    message: String,
}

impl From<crate::serving::Warning> for Warning {
    fn from(warning: crate::serving::Warning) -> Self {
        Self { field: warning.field, message: warning.message }
    }
}
