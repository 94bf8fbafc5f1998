//! The frame and the world of a fleet in requests; the checks are the same for all transports.

use crate::env::{Boundary, Point};
use crate::invalid::{Invalid, in_range};
use crate::serving::{Constraint, ConstraintOptions, FlightOptions, FrameOptions, WorldOptions, Zone};
use crate::wire::v1;

/// What a request says about its fleet, not checked yet.
#[derive(Clone, Debug, Default)]
pub struct FlightFields {
    /// The area.
    pub frame: Option<FrameFields>,
    /// The world.
    pub world: Option<WorldOptions>,
    /// Whether detections are mirrored.
    pub symmetric: Option<bool>,
    /// The constraints.
    pub constraints: Option<ConstraintOptions>,
}

/// The area of a request, not checked yet.
#[derive(Clone, Copy, Debug, Default)]
pub struct FrameFields {
    /// Default: (0, 0).
    pub origin: Option<Point>,
    /// Instead of width and height.
    pub side: Option<f64>,
    /// Along the x axis of the area.
    pub width: Option<f64>,
    /// Along the y axis of the area.
    pub height: Option<f64>,
    /// In degrees, counter-clockwise.
    pub rotation_deg: f64,
}

impl FlightFields {
    /// The options; `None` if the request says nothing.
    ///
    /// # Errors
    /// [`Invalid`] for an area without size, or with two sizes.
    pub fn options(self) -> Result<Option<Box<FlightOptions>>, Invalid> {
        let Self { frame, world, symmetric, constraints } = self;
        if frame.is_none() && world.is_none() && symmetric.is_none() && constraints.is_none() {
            return Ok(None);
        }
        let frame = frame.map(FrameFields::options).transpose()?;
        let (world, symmetric) = (world.unwrap_or_default(), symmetric.unwrap_or(true));
        Ok(Some(Box::new(FlightOptions { frame, world, symmetric, constraints })))
    }
}

/// What is accepted beside the side of a square area.
const SIDE_ALONE: &str = "no value beside frame.side, which is width and height";

impl FrameFields {
    fn options(self) -> Result<FrameOptions, Invalid> {
        let (width, height) = match (self.side, self.width, self.height) {
            (Some(side), None, None) => {
                in_range("frame.side", side, FrameOptions::LENGTH)?;
                (side, side)
            }
            (Some(_), Some(width), _) => return Err(Invalid::new("frame.width", width, SIDE_ALONE)),
            (Some(_), None, Some(height)) => return Err(Invalid::new("frame.height", height, SIDE_ALONE)),
            (None, Some(width), Some(height)) => (width, height),
            (None, Some(_), None) => return Err(Invalid::missing("frame.height", "the length of the area along its y axis")),
            (None, None, Some(_)) => return Err(Invalid::missing("frame.width", "the length of the area along its x axis")),
            (None, None, None) => return Err(Invalid::missing("frame.side", "side, or width and height")),
        };
        Ok(FrameOptions { origin: self.origin.unwrap_or_default(), width, height, rotation_deg: self.rotation_deg })
    }
}

impl From<v1::Frame> for FrameFields {
    fn from(frame: v1::Frame) -> Self {
        let v1::Frame { origin, side, width, height, rotation_deg } = frame;
        Self { origin: origin.map(|at| [at.x, at.y]), side, width, height, rotation_deg }
    }
}

/// The world of a message.
///
/// # Errors
/// [`Invalid`] for an unknown boundary.
pub fn world(world: v1::World) -> Result<WorldOptions, Invalid> {
    let v1::World { slot_seconds, speed, transmission_range, detection_range, communication_range, slots, boundary } = world;
    let boundary = match v1::Boundary::try_from(boundary) {
        Ok(v1::Boundary::Unspecified) => None,
        Ok(v1::Boundary::Clamp) => Some(Boundary::Clamp),
        Ok(v1::Boundary::Free) => Some(Boundary::Free),
        Err(_) => return Err(Invalid::new("world.boundary", boundary, "BOUNDARY_CLAMP (1) or BOUNDARY_FREE (2)")),
    };
    let slots = slots.map(|slots| slots as usize);
    Ok(WorldOptions { slot_seconds, speed, transmission_range, detection_range, communication_range, slots, boundary })
}

/// The zone of a request: a polygon, or a circle.
///
/// # Errors
/// [`Invalid`] if it is neither; `i` is its index.
pub fn zone(i: usize, corners: Vec<Point>, center: Option<Point>, radius: Option<f64>) -> Result<Zone, Invalid> {
    match (center, radius) {
        (None, None) => Ok(Zone::Polygon(corners)),
        (Some(center), Some(radius)) if corners.is_empty() => Ok(Zone::Circle(center, radius)),
        _ => Err(Invalid::new(format!("constraints.no_fly[{i}]"), "a zone", "either corners, or a center and a radius")),
    }
}

/// The constraints of a message.
///
/// # Errors
/// As [`zone`].
pub fn constraints(constraints: v1::Constraints) -> Result<ConstraintOptions, Invalid> {
    let v1::Constraints { no_fly, min_separation, home, max_distance, return_in_time } = constraints;
    let point = |at: v1::Position| [at.x, at.y];
    let zones = no_fly
        .into_iter()
        .enumerate()
        .map(|(i, of)| zone(i, of.corners.into_iter().map(point).collect(), of.center.map(point), of.radius));
    let no_fly = zones.collect::<Result<_, _>>()?;
    Ok(ConstraintOptions { no_fly, min_separation, home: home.map(point), max_distance, return_in_time })
}

impl From<Constraint> for v1::Constraint {
    fn from(constraint: Constraint) -> Self {
        match constraint {
            Constraint::NoFly => Self::NoFly,
            Constraint::Separation => Self::MinSeparation,
            Constraint::MaxDistance => Self::MaxDistance,
            Constraint::ReturnInTime => Self::ReturnInTime,
        }
    }
}

/// The fields of a message.
///
/// # Errors
/// As [`world`] and [`constraints`].
pub fn fields(
    frame: Option<v1::Frame>,
    of: Option<v1::World>,
    symmetric: Option<bool>,
    limits: Option<v1::Constraints>,
) -> Result<FlightFields, Invalid> {
    let (world, constraints) = (of.map(world).transpose()?, limits.map(constraints).transpose()?);
    Ok(FlightFields { frame: frame.map(Into::into), world, symmetric, constraints })
}
