//! Wire types to domain types and back. Wire types stop here; everything that can be wrong with a request and does not
//! depend on the policy is found here, with the path of the field.

pub mod environments;
pub mod events;
mod fleet;
mod graph;
pub mod jobs;
pub mod request;
pub mod response;
mod scene;
pub mod structs;
pub mod tensors;

use fleet::Ids;

use crate::env::Point;
use crate::invalid::{Invalid, in_range};

/// Largest coordinate of an absolute position, in units of the square's side.
const FARTHEST: f64 = 1e4;
/// Largest AoI, in slots.
const OLDEST: f64 = 1e6;

fn finite(field: impl FnOnce() -> String, value: f64) -> Result<f64, Invalid> {
    if value.is_finite() { Ok(value) } else { Err(Invalid::new(field(), value, "a finite number")) }
}

fn point(field: impl Fn() -> String, x: f64, y: f64) -> Result<Point, Invalid> {
    for (axis, value) in [("x", x), ("y", y)] {
        if !(-FARTHEST..=FARTHEST).contains(&value) {
            finite(|| format!("{}.{axis}", field()), value)?;
            in_range(&format!("{}.{axis}", field()), value, -FARTHEST..=FARTHEST)?;
        }
    }
    Ok([x, y])
}

fn aoi(field: impl Fn() -> String, value: f64) -> Result<f32, Invalid> {
    if !(0.0..=OLDEST).contains(&value) {
        finite(&field, value)?;
        in_range(&field(), value, 0.0..=OLDEST)?;
    }
    Ok(value as f32)
}

fn name(field: &str, id: &str) -> Result<(), Invalid> {
    let longest = crate::serving::Fleet::LONGEST_ID;
    if !id.is_empty() && id.chars().count() <= longest {
        return Ok(());
    }
    Err(Invalid::new(field, format!("{id:?}"), format!("1 to {longest} characters")))
}

#[cfg(test)]
mod tests;
