//! Fleets whose UAVs and users change during an episode (docs/model.md, "Changing fleets"): what a policy is told about a fleet
//! that has changed or whose UAVs differ, and how memory follows its UAVs and users. `serving::Roster` decides who belongs to a fleet.

use std::f64::consts::{PI, TAU};

use super::EnvParams;
use crate::env::Point;

/// The sector of a UAV: its direction around the centre of the square, and what lies nearer to it than to that of a neighbour. UAV i of M
/// has the angle 2 pi i / M. When the fleet changes, every UAV keeps its angle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sector {
    /// In radians.
    pub angle: f64,
    /// Half the angles between this UAV and the neighbouring UAVs, clockwise and counter-clockwise.
    half_gaps: [f64; 2],
}

impl Sector {
    /// The sector of UAV `i` of `uavs` that fly together from slot 0.
    pub fn of(i: usize, uavs: usize) -> Self {
        Self { angle: TAU * i as f64 / uavs as f64, half_gaps: [PI / uavs as f64; 2] }
    }

    /// The sectors of UAVs with these angles, in radians.
    pub fn at_angles(angles: &[f64]) -> Vec<Self> {
        let mut order: Vec<usize> = (0..angles.len()).collect();
        order.sort_by(|&a, &b| angles[a].total_cmp(&angles[b]).then(a.cmp(&b)));
        let mut sectors: Vec<Self> = angles.iter().map(|&angle| Self { angle, half_gaps: [PI; 2] }).collect();
        if order.len() > 1 {
            for (k, &i) in order.iter().enumerate() {
                let next = order[(k + 1) % order.len()];
                let half = (angles[next] - angles[i]).rem_euclid(TAU) / 2.0;
                sectors[i].half_gaps[1] = half;
                sectors[next].half_gaps[0] = half;
            }
        }
        sectors
    }

    /// Whether `p` is in this sector: in its direction rather than in that of a neighbour. UAVs that start together search
    /// different ground.
    pub fn owns(&self, p: Point) -> bool {
        self.owns_direction(direction(p))
    }

    /// As [`Sector::owns`] for a point in this [`direction`].
    pub(super) fn owns_direction(&self, direction: f64) -> bool {
        let off = turn(direction - self.angle);
        off <= self.half_gaps[1] || TAU - off <= self.half_gaps[0]
    }
}

/// The direction of a point around the centre of the square, in radians from -pi to pi.
pub(super) fn direction(p: Point) -> f64 {
    (p[1] - 0.5).atan2(p[0] - 0.5)
}

/// `angle` as an angle of at least 0 and less than 2 pi. The same bits as `angle.rem_euclid(TAU)`, without a division for less than two
/// turns.
fn turn(angle: f64) -> f64 {
    if angle.abs() >= 2.0 * TAU {
        return angle.rem_euclid(TAU);
    }
    // Exact: the sum of numbers of different sign whose sizes differ at most by a factor of 2.
    let rest = if angle >= TAU {
        angle - TAU
    } else if angle <= -TAU {
        angle + TAU
    } else {
        angle
    };
    if rest < 0.0 { rest + TAU } else { rest }
}

/// How many users there are, for a memory that has room for N.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum UserCount {
    /// N, since slot 0.
    #[default]
    Fixed,
    /// The first so many of the N in the memory: users have come or gone, and the fleet's input lists all that there are.
    Listed(usize),
    /// Unknown: the fleet's input may list only some.
    Unknown,
}

/// How a fleet differs from one of equal UAVs that has not changed since slot 0.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FleetProfile {
    /// The sector of each UAV. Empty: the UAVs are those of slot 0.
    pub sectors: Vec<Sector>,
    /// How many users there are.
    pub users: UserCount,
    /// Speed of each UAV, per slot. Empty: all have that of the environment.
    pub speeds: Vec<f64>,
}

impl FleetProfile {
    /// The sector of UAV `i` of `uavs`.
    pub fn sector(profile: Option<&Self>, i: usize, uavs: usize) -> Sector {
        profile.and_then(|profile| profile.sectors.get(i).copied()).unwrap_or_else(|| Sector::of(i, uavs))
    }

    /// The environment of UAV `i`.
    pub fn env(profile: Option<&Self>, env: &EnvParams, i: usize) -> EnvParams {
        EnvParams { speed: profile.and_then(|profile| profile.speeds.get(i).copied()).unwrap_or(env.speed), ..*env }
    }

    /// How many users there are.
    pub fn users(profile: Option<&Self>) -> UserCount {
        profile.map_or(UserCount::Fixed, |profile| profile.users)
    }
}

/// How the UAVs and users of one memory are found in another: pairs of an index in the first and an index in the second.
#[derive(Clone, Copy, Debug)]
pub struct Carry<'a> {
    /// (M, N) of the first memory.
    pub from: (usize, usize),
    /// (M, N) of the second memory.
    pub to: (usize, usize),
    /// UAVs in both.
    pub uavs: &'a [(u32, u32)],
    /// Users in both.
    pub users: &'a [(u32, u32)],
}

impl Carry<'_> {
    /// Copies the `width` numbers of each UAV.
    pub(super) fn uav_rows(&self, width: usize, from: &[f32], to: &mut [f32]) {
        for &(a, b) in self.uavs {
            to[b as usize * width..][..width].copy_from_slice(&from[a as usize * width..][..width]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regular_sectors_are_the_same_in_both_forms() {
        for uavs in 1..9 {
            let angles: Vec<f64> = (0..uavs).map(|i| Sector::of(i, uavs).angle).collect();
            for (i, sector) in Sector::at_angles(&angles).into_iter().enumerate() {
                let regular = Sector::of(i, uavs);
                assert_eq!(sector.angle.to_bits(), regular.angle.to_bits());
                assert!(sector.half_gaps.iter().all(|half| (half - PI / uavs as f64).abs() < 1e-12));
                for k in 0..97 {
                    let angle = TAU * (f64::from(k) + 0.37) / 97.0;
                    let p = [0.5 + 0.3 * angle.cos(), 0.5 + 0.3 * angle.sin()];
                    assert_eq!(sector.owns(p), regular.owns(p), "{i} of {uavs}, {angle}");
                }
            }
        }
    }

    #[test]
    fn turns_are_euclidean_remainders_to_the_bit() {
        for k in -4000..4000 {
            for angle in [f64::from(k) * 0.0123, f64::from(k) * TAU / 8.0] {
                // Zeros of both signs are equal.
                assert_eq!(turn(angle), angle.rem_euclid(TAU), "{angle}");
            }
        }
        assert!(turn(f64::NAN).is_nan());
    }

    #[test]
    fn irregular_sectors_cover_everything_once() {
        let sectors = Sector::at_angles(&[0.1, 5.0, 0.3, 3.0]);
        for k in 0..360 {
            let angle = f64::from(k).to_radians() + 1e-3;
            let p = [0.5 + 0.3 * angle.cos(), 0.5 + 0.3 * angle.sin()];
            assert_eq!(sectors.iter().filter(|sector| sector.owns(p)).count(), 1, "{k}");
        }
    }
}
