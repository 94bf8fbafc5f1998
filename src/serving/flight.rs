//! How a caller describes its fleet, and the world that the fleet flies in: the frame of its coordinates (`frame` translates them), the
//! world where it differs from that of the policy, and what detections mean.

use std::sync::Arc;

use super::frame::{Frame, FrameOptions};
use super::{Guard, Scene, SceneOrGraph, Sensing, Zone};
use crate::env::{Boundary, DIRECTIONS, EnvConfig, Point};
use crate::invalid::{Invalid, in_range, tidy};
use crate::policy::{EnvParams, Policy};

/// Largest distance of a coordinate from the unit square. Beyond, the caller uses other units.
const MAX_DISTANCE: f64 = 10.0;

/// Everything about a fleet that its requests do not repeat. Lengths are in units of the caller's frame.
#[derive(Clone, Debug, PartialEq)]
pub struct FlightOptions {
    /// The area in the caller's coordinates; absent: the unit square.
    pub frame: Option<FrameOptions>,
    /// Where the world differs from that of the policy.
    pub world: WorldOptions,
    /// See [`Sensing`].
    pub symmetric: bool,
    /// What no heading may break.
    pub constraints: Option<ConstraintOptions>,
}

impl FlightOptions {
    /// The first field of the request that these options come from.
    pub fn first_field(&self) -> &'static str {
        match self {
            Self { frame: Some(_), .. } => "frame",
            Self { constraints: Some(_), .. } => "constraints",
            Self { world, .. } if *world != WorldOptions::default() => "world",
            _ => "symmetric",
        }
    }
}

impl Default for FlightOptions {
    fn default() -> Self {
        Self { frame: None, world: WorldOptions::default(), symmetric: true, constraints: None }
    }
}

/// The world of a fleet; absent: that of the policy.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WorldOptions {
    /// Duration of a slot; absent: 1, so that a speed is a distance per slot.
    pub slot_seconds: Option<f64>,
    /// Speed of the UAVs, per second.
    pub speed: Option<f64>,
    /// Range within which a UAV collects data.
    pub transmission_range: Option<f64>,
    /// Range within which nodes detect each other.
    pub detection_range: Option<f64>,
    /// Range within which UAVs exchange messages; absent: the detection range.
    pub communication_range: Option<f64>,
    /// How far policies that plan look ahead, in slots.
    pub slots: Option<usize>,
    /// What happens at the border of the area.
    pub boundary: Option<Boundary>,
}

/// Constraints, in units of the caller.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ConstraintOptions {
    /// Zones that no UAV enters.
    pub no_fly: Vec<Zone>,
    /// Minimum distance between two UAVs.
    pub min_separation: Option<f64>,
    /// Where UAVs return to.
    pub home: Option<Point>,
    /// Maximum distance from home.
    pub max_distance: Option<f64>,
    /// Whether every UAV reaches home before its battery is empty.
    pub return_in_time: bool,
}

impl ConstraintOptions {
    /// Maximum number of zones, and of corners of a zone.
    const MAX_ZONES: usize = 64;

    fn guard(&self, frame: Option<&Frame>, boundary: Boundary) -> Result<Guard, Invalid> {
        let point = |field: &str, [x, y]: Point| {
            in_range(&format!("{field}.x"), x, -1e9..=1e9)?;
            in_range(&format!("{field}.y"), y, -1e9..=1e9)?;
            Ok(frame.map_or([x, y], |frame| frame.point_in([x, y])))
        };
        let length = |field: &str, value: f64| {
            in_range(field, value, 0.0..=1e9)?;
            Ok(value / frame.map_or(1.0, |frame| frame.scale))
        };
        if self.no_fly.len() > Self::MAX_ZONES {
            let expected = format!("at most {} zones", Self::MAX_ZONES);
            return Err(Invalid::new("constraints.no_fly", format!("{} zones", self.no_fly.len()), expected));
        }
        let zone = |(i, zone): (usize, &Zone)| {
            let field = format!("constraints.no_fly[{i}]");
            match zone {
                Zone::Circle(center, radius) => {
                    Ok(Zone::Circle(point(&format!("{field}.center"), *center)?, length(&format!("{field}.radius"), *radius)?))
                }
                Zone::Polygon(corners) if (3..=Self::MAX_ZONES).contains(&corners.len()) => {
                    let corners = corners.iter().enumerate().map(|(k, corner)| point(&format!("{field}.corners[{k}]"), *corner));
                    Ok(Zone::Polygon(corners.collect::<Result<_, Invalid>>()?))
                }
                Zone::Polygon(corners) => {
                    let expected = format!("3 to {} corners, or a center and a radius", Self::MAX_ZONES);
                    Err(Invalid::new(format!("{field}.corners"), format!("{} corners", corners.len()), expected))
                }
            }
        };
        if self.home.is_none() && (self.max_distance.is_some() || self.return_in_time) {
            return Err(Invalid::missing("constraints.home", "the position that UAVs return to"));
        }
        Ok(Guard {
            no_fly: self.no_fly.iter().enumerate().map(zone).collect::<Result<_, Invalid>>()?,
            min_separation: self.min_separation.map_or(Ok(0.0), |value| length("constraints.min_separation", value))?,
            home: self.home.map(|home| point("constraints.home", home)).transpose()?,
            max_distance: self.max_distance.map(|value| length("constraints.max_distance", value)).transpose()?,
            return_in_time: self.return_in_time,
            boundary,
        })
    }
}

/// Something that a caller should know about its session.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Warning {
    /// The field of the request, such as `world.speed`.
    pub field: &'static str,
    /// What it means.
    pub message: String,
}

/// The world of one fleet, for one policy.
#[derive(Clone, Debug, PartialEq)]
pub struct Flight {
    /// Absent: the unit square.
    pub frame: Option<Frame>,
    /// In units of the square's side.
    pub env: EnvParams,
    /// See [`Sensing`].
    pub symmetric: bool,
    /// What no heading may break.
    pub guard: Option<Arc<Guard>>,
    boundary: Boundary,
    slot_seconds: f64,
}

impl Flight {
    /// The flight of a fleet with `policy`.
    ///
    /// # Errors
    /// [`Invalid`] for the first option that is out of range.
    pub fn new(options: &FlightOptions, policy: &dyn Policy) -> Result<Self, Invalid> {
        let frame = options.frame.map(Frame::new).transpose()?;
        let scale = frame.map_or(1.0, |frame| frame.scale);
        let (world, trained) = (&options.world, policy.env());
        let slot_seconds = world.slot_seconds.unwrap_or(1.0);
        in_range("world.slot_seconds", slot_seconds, 1e-3..=1e6)?;
        let length = |field: &str, value: Option<f64>, default: f64, least: f64, most: f64| {
            let Some(value) = value else { return Ok(default) };
            in_range(field, value, least * scale..=most * scale).map(|()| value / scale)
        };
        let speed = match world.speed {
            None => trained.speed,
            Some(speed) => {
                in_range("world.speed", speed, 0.0..=scale / slot_seconds)?;
                speed * slot_seconds / scale
            }
        };
        let detection = length("world.detection_range", world.detection_range, trained.detection_range, 1e-6, 2.0)?;
        let transmission = length("world.transmission_range", world.transmission_range, trained.transmission_range, 0.0, 2.0)?;
        let default = if world.detection_range.is_some() { detection } else { trained.communication_range };
        let communication = length("world.communication_range", world.communication_range, default, 0.0, 10.0)?;
        if transmission > detection {
            let expected = format!("at least the transmission range ({})", tidy(transmission * scale));
            return Err(Invalid::new("world.detection_range", tidy(detection * scale), expected));
        }
        let slots = world.slots.unwrap_or(trained.slots);
        in_range("world.slots", slots, 1..=10_000)?;
        let env = EnvParams {
            speed,
            transmission_range: transmission,
            detection_range: detection,
            communication_range: communication,
            slots,
            extent: frame.map_or([1.0; 2], |frame| frame.extent()),
            ..trained
        };
        let boundary = world.boundary.unwrap_or_default();
        let guard = options.constraints.as_ref().map(|constraints| constraints.guard(frame.as_ref(), boundary).map(Arc::new));
        Ok(Self { frame, env, symmetric: options.symmetric, guard: guard.transpose()?, boundary, slot_seconds })
    }

    /// The flight in the unit square and in the world of `policy`.
    pub fn plain(policy: &dyn Policy) -> Self {
        Self { frame: None, env: policy.env(), symmetric: true, guard: None, boundary: Boundary::Clamp, slot_seconds: 1.0 }
    }

    /// What the policy detects.
    pub fn sensing(&self) -> Sensing {
        Sensing { ranges: self.env.ranges(), symmetric: self.symmetric, frame: self.frame }
    }

    /// How the world differs from the one that `policy` was trained in, or made for.
    pub fn warnings(&self, policy: &dyn Policy) -> Vec<Warning> {
        let trained = policy.env();
        let scale = self.frame.map_or(1.0, |frame| frame.scale);
        let pairs = [
            ("world.speed", self.env.speed, trained.speed, scale / self.slot_seconds),
            ("world.transmission_range", self.env.transmission_range, trained.transmission_range, scale),
            ("world.detection_range", self.env.detection_range, trained.detection_range, scale),
            ("world.communication_range", self.env.communication_range, trained.communication_range, scale),
            ("world.slots", self.env.slots as f64, trained.slots as f64, 1.0),
        ];
        let differs = |now: f64, trained: f64| (now - trained).abs() > 0.01 * trained.abs();
        let differing = pairs.into_iter().filter(|&(_, now, trained, _)| differs(now, trained));
        let warning = |(field, now, trained, unit): (&'static str, f64, f64, f64)| {
            let (now, trained) = (tidy(now * unit), tidy(trained * unit));
            let rule = policy.rule_in(&self.env).filter(|_| field == "world.detection_range");
            let flies = |rule| format!("; with a range below its training the policy flies exactly as the rule {rule}");
            let flies = rule.map(flies).unwrap_or_default();
            Warning { field, message: format!("{now} here, {trained} in the world that the policy was made for{flies}") }
        };
        let shape = (self.env.extent != [1.0; 2])
            .then(|| Warning { field: "frame", message: "the area is a rectangle; the policy was made for a square".into() });
        differing.map(warning).chain(shape).collect()
    }

    /// Translates an input to the unit square. `far`: the error if the caller's coordinates are not near it.
    ///
    /// # Errors
    /// [`Invalid`] if positions are far from the area.
    pub fn translate(&self, content: &mut SceneOrGraph, far: Option<Box<Invalid>>) -> Result<(), Invalid> {
        let Some(frame) = &self.frame else { return far.map_or(Ok(()), |far| Err(*far)) };
        let mut outside = None;
        let mut point = |at: &mut Point| {
            let to = frame.point_in(*at);
            if is_far(to) {
                outside.get_or_insert(*at);
            }
            *at = to;
        };
        match content {
            SceneOrGraph::Scene(Scene { uavs, users, .. }) => uavs.iter_mut().chain(users).for_each(point),
            SceneOrGraph::Graph(graph) => {
                graph.positions.iter_mut().flatten().for_each(&mut point);
                graph.detections.iter_mut().flatten().for_each(|detection| detection.rel = frame.vector_in(detection.rel));
            }
        }
        let Some([x, y]) = outside else { return Ok(()) };
        let expected =
            format!("an area whose longer side is at least a tenth of the distance to ({x}, {y}), the position of a node");
        Err(Invalid::new("frame", format!("{} x {}", frame.options.width, frame.options.height), expected))
    }

    /// The speed of each UAV, in sides of the square per slot, where `own` has speeds of the caller; empty if it has none. `field`: the
    /// field of the request that has the speed of a UAV.
    ///
    /// # Errors
    /// [`Invalid`] if a UAV is too fast.
    pub fn speeds(&self, own: &[Option<f64>], field: impl Fn(usize) -> String) -> Result<Vec<f64>, Invalid> {
        let scale = self.frame.map_or(1.0, |frame| frame.scale);
        let most = scale / self.slot_seconds;
        let speed = |(i, speed): (usize, &Option<f64>)| match *speed {
            None => Ok(self.env.speed),
            Some(speed) if (0.0..=most).contains(&speed) => Ok(speed * self.slot_seconds / scale),
            Some(speed) => Err(Invalid::new(field(i), speed, format!("a number from 0 to {}", tidy(most)))),
        };
        own.iter().enumerate().map(speed).collect()
    }

    /// A length in the square, in units of the caller.
    pub fn length(&self, length: f64) -> f64 {
        length * self.frame.map_or(1.0, |frame| frame.scale)
    }

    /// A speed in sides of the square per slot, in units of the caller per second.
    pub fn speed_out(&self, speed: f64) -> f64 {
        self.length(speed) / self.slot_seconds
    }

    /// The slots that each UAV can still fly, where the caller says so.
    pub fn endurance(&self, seconds: &[Option<f64>]) -> Vec<f64> {
        seconds.iter().map(|seconds| seconds.map_or(f64::INFINITY, |seconds| (seconds / self.slot_seconds).floor())).collect()
    }

    /// The direction of a heading in the caller's coordinates, in degrees; `None` for hover.
    pub fn degrees(&self, heading: u8) -> Option<f64> {
        let own = degrees(heading)?;
        Some(self.frame.map_or(own, |frame| (own + frame.options.rotation_deg).rem_euclid(360.0)))
    }

    /// The velocity of a UAV on a heading, in units of the caller per second; the border of the area does not change it. `speed`: its own
    /// speed, in these units.
    pub fn velocity(&self, heading: u8, speed: Option<f64>) -> Point {
        let scale = self.frame.map_or(1.0, |frame| frame.scale);
        let speed = speed.unwrap_or(self.env.speed * scale / self.slot_seconds);
        let [x, y] = DIRECTIONS[usize::from(heading).min(EnvConfig::COMPASS)];
        let [cos, sin] = self.frame.map_or([1.0, 0.0], |frame| frame.axis);
        [(x * cos - y * sin) * speed, (x * sin + y * cos) * speed]
    }

    /// Where a UAV that is at `at` in the square will be after the slot, in the caller's coordinates.
    pub fn waypoint(&self, at: Point, heading: u8, speed: Option<f64>) -> Point {
        let scale = self.frame.map_or(1.0, |frame| frame.scale);
        let step = speed.map_or(self.env.speed, |speed| speed * self.slot_seconds / scale);
        let direction = DIRECTIONS[usize::from(heading).min(EnvConfig::COMPASS)];
        let end = |axis: usize| self.boundary.limit(at[axis], at[axis] + step * direction[axis], self.env.extent[axis]);
        let to = [end(0), end(1)];
        self.frame.map_or(to, |frame| frame.point_out(to))
    }
}

/// The direction of a heading in the unit square in degrees, counter-clockwise from +x; `None` for hover.
pub fn degrees(heading: u8) -> Option<f64> {
    /// Number of headings with a direction; the next index is hover.
    const COMPASS: u8 = EnvConfig::COMPASS as u8;
    (heading < COMPASS).then(|| 360.0 / f64::from(COMPASS) * f64::from(heading))
}

/// Whether a position is so far from the unit square that it must be in other units.
pub(crate) fn is_far([x, y]: Point) -> bool {
    !(-MAX_DISTANCE..=MAX_DISTANCE).contains(&x) || !(-MAX_DISTANCE..=MAX_DISTANCE).contains(&y)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::baselines::by_name;

    fn flight(width: f64, height: f64, rotation_deg: f64) -> Flight {
        let frame = Some(FrameOptions { origin: [500.0, -200.0], width, height, rotation_deg });
        let world = WorldOptions { slot_seconds: Some(8.0), speed: Some(15.0), ..WorldOptions::default() };
        let options = FlightOptions { frame, world, ..FlightOptions::default() };
        Flight::new(&options, &*by_name("sweep", EnvParams::default()).unwrap()).unwrap()
    }

    #[test]
    fn coordinates_go_in_and_out() {
        for (width, height, rotation) in [(3000.0, 2000.0, 0.0), (2000.0, 3000.0, 30.0), (1000.0, 1000.0, -90.0)] {
            let frame = flight(width, height, rotation).frame.unwrap();
            for at in [[500.0, -200.0], [1700.0, 900.0], [-50.0, 20.0]] {
                let back = frame.point_out(frame.point_in(at));
                assert!((back[0] - at[0]).abs() < 1e-6 && (back[1] - at[1]).abs() < 1e-6);
            }
            let corner = frame.point_in([500.0, -200.0]);
            let [w, h] = frame.extent();
            assert!((corner[0] - (1.0 - w) / 2.0).abs() < 1e-12 && (corner[1] - (1.0 - h) / 2.0).abs() < 1e-12);
        }
    }

    #[test]
    fn headings_velocities_and_waypoints_are_in_the_frame() {
        let flight = flight(3000.0, 2000.0, 90.0);
        assert_eq!(flight.degrees(0), Some(90.0));
        assert_eq!(flight.degrees(7), Some(45.0));
        assert_eq!(flight.degrees(8), None);
        assert_eq!(flight.velocity(0, None), [0.0, 15.0]);
        assert_eq!(flight.velocity(8, None), [0.0, 0.0]);
        // The x axis of the area points to +y of the caller.
        let at = flight.frame.unwrap().point_in([500.0, -200.0]);
        let [x, y] = flight.waypoint(at, 0, Some(20.0));
        assert!((x - 500.0).abs() < 1e-6 && (y - -40.0).abs() < 1e-6, "{x}, {y}");
        let [x, y] = flight.waypoint(at, 4, None);
        assert!((x - 500.0).abs() < 1e-6 && (y - -200.0).abs() < 1e-6, "clamped to the area: {x}, {y}");
    }

    #[test]
    fn waypoints_of_uavs_outside_of_the_area_can_be_reached() {
        let flight = flight(1000.0, 1000.0, 0.0);
        let at = flight.frame.unwrap().point_in([200.0, 300.0]);
        for (heading, expected) in [(0, [320.0, 300.0]), (2, [200.0, 420.0]), (4, [200.0, 300.0])] {
            let [x, y] = flight.waypoint(at, heading, None);
            assert!((x - expected[0]).abs() < 1e-6 && (y - expected[1]).abs() < 1e-6, "{heading}: {x}, {y}");
        }
    }
}
