//! What the UAVs of one fleet detect in one slot, borrowed from a [`super::FleetGraph`] or a [`super::Geometry`].

use super::neighbor_search::Detection;
use crate::env::Point;

/// The positions of the UAVs and what they detect.
#[derive(Clone, Copy, Debug)]
pub struct Sight<'a> {
    /// Position of each UAV.
    pub positions: &'a [Point],
    /// AoI of each user, in slots.
    pub aoi: &'a [f32],
    /// The detections of UAV i are `detections[offsets[i]..offsets[i + 1]]`, in ascending order of target.
    pub offsets: &'a [u32],
    /// Detections of UAVs (targets below M) and of users (from M).
    pub detections: &'a [Detection],
}

impl<'a> Sight<'a> {
    /// M.
    pub fn uavs(&self) -> usize {
        self.positions.len()
    }

    /// N.
    pub fn users(&self) -> usize {
        self.aoi.len()
    }

    fn split(&self, i: usize) -> (&'a [Detection], &'a [Detection]) {
        let detections = &self.detections[self.offsets[i] as usize..self.offsets[i + 1] as usize];
        detections.split_at(detections.partition_point(|d| (d.target as usize) < self.uavs()))
    }

    /// Indices and positions of the UAVs that UAV `i` detects.
    pub fn detected_uavs(&self, i: usize) -> impl Iterator<Item = (usize, Point)> + Clone + 'a {
        let at = self.positions[i];
        self.split(i).0.iter().map(move |d| (d.target as usize, position(at, d)))
    }

    /// Indices and positions of the users that UAV `i` detects.
    pub fn detected_users(&self, i: usize) -> impl Iterator<Item = (usize, Point)> + 'a {
        let (at, uavs) = (self.positions[i], self.uavs());
        self.split(i).1.iter().map(move |d| (d.target as usize - uavs, position(at, d)))
    }
}

fn position(at: Point, detection: &Detection) -> Point {
    [at[0] + f64::from(detection.rel[0]), at[1] + f64::from(detection.rel[1])]
}
