//! The frame of a caller: the area that its fleet flies in, in its own coordinates, and their translation to and from the unit square.

use crate::env::Point;
use crate::invalid::{Invalid, in_range};

/// The area that a fleet flies in, a rectangle in the coordinates of the caller.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameOptions {
    /// The corner with the smallest coordinates along the axes of the area.
    pub origin: Point,
    /// Length along the x axis of the area.
    pub width: f64,
    /// Length along the y axis of the area.
    pub height: f64,
    /// Direction of the x axis of the area, in degrees counter-clockwise from the x axis of the caller.
    pub rotation_deg: f64,
}

impl FrameOptions {
    /// Lengths of the sides of an area.
    pub const LENGTH: std::ops::RangeInclusive<f64> = 1e-6..=1e9;
}

/// The translation between the coordinates of a caller and the unit square. The area lies in the middle of the square, its longer side
/// is as long as that of the square.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    pub(super) options: FrameOptions,
    /// Length of the square's side.
    pub(super) scale: f64,
    /// Direction of the x axis of the area.
    pub(super) axis: [f64; 2],
}

impl Frame {
    /// The frame of these options.
    ///
    /// # Errors
    /// [`Invalid`] for the first option that is out of range.
    pub fn new(options: FrameOptions) -> Result<Self, Invalid> {
        in_range("frame.origin.x", options.origin[0], -1e9..=1e9)?;
        in_range("frame.origin.y", options.origin[1], -1e9..=1e9)?;
        in_range("frame.width", options.width, FrameOptions::LENGTH)?;
        in_range("frame.height", options.height, FrameOptions::LENGTH)?;
        in_range("frame.rotation_deg", options.rotation_deg, -360.0..=360.0)?;
        let (width, height) = (options.width, options.height);
        if width.max(height) > 100.0 * width.min(height) {
            return Err(Invalid::new(
                "frame",
                format!("{width} x {height}"),
                "a longer side of at most 100 times the shorter one",
            ));
        }
        // Exact for the axes.
        let (sin, cos) = match options.rotation_deg.rem_euclid(360.0) {
            0.0 => (0.0, 1.0),
            90.0 => (1.0, 0.0),
            180.0 => (0.0, -1.0),
            270.0 => (-1.0, 0.0),
            other => other.to_radians().sin_cos(),
        };
        Ok(Self { options, scale: width.max(height), axis: [cos, sin] })
    }

    /// A length in the square, in units of the caller.
    pub(super) fn length_out(&self, length: f64) -> f64 {
        length * self.scale
    }

    /// Width and height of the area, in units of the square's side.
    pub(super) fn extent(&self) -> [f64; 2] {
        [self.options.width / self.scale, self.options.height / self.scale]
    }

    /// A difference of positions of the caller, in the square.
    pub(super) fn vector_in(&self, [x, y]: Point) -> Point {
        let [cos, sin] = self.axis;
        [(x * cos + y * sin) / self.scale, (y * cos - x * sin) / self.scale]
    }

    /// A difference of positions in the square, in the coordinates of the caller.
    pub(super) fn vector_out(&self, [x, y]: Point) -> Point {
        let [cos, sin] = self.axis;
        [(x * cos - y * sin) * self.scale, (x * sin + y * cos) * self.scale]
    }

    /// A position of the caller, in the square.
    pub(super) fn point_in(&self, [x, y]: Point) -> Point {
        let [origin_x, origin_y] = self.options.origin;
        let ([width, height], [x, y]) = (self.extent(), self.vector_in([x - origin_x, y - origin_y]));
        [x + (1.0 - width) / 2.0, y + (1.0 - height) / 2.0]
    }

    pub(super) fn point_out(&self, [x, y]: Point) -> Point {
        let [width, height] = self.extent();
        let [x, y] = self.vector_out([x - (1.0 - width) / 2.0, y - (1.0 - height) / 2.0]);
        [x + self.options.origin[0], y + self.options.origin[1]]
    }
}
