//! Episodes in compact form, as replay holds and updates read them (docs/model.md, "Replay"). Observations are recomputed, never
//! stored.

use crate::env::EnvConfig;
use crate::policy::EnvParams;

/// A batch of B episodes of equal size, as a structure of arrays. Positions are f32, as in the environment.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Episodes {
    /// The environment.
    pub env: EnvParams,
    /// Number of episodes B.
    pub len: usize,
    /// Number of UAVs M.
    pub uavs: usize,
    /// Number of users N.
    pub users: usize,
    /// Slots per episode K.
    pub slots: usize,
    /// (B, K+1, M, 2) UAV positions.
    pub uav_xy: Vec<f32>,
    /// (B, S, N, 2) user positions; S = 1 if users stay, K+1 if they move.
    pub user_xy: Vec<f32>,
    /// Whether users move.
    pub users_move: bool,
    /// (B, K+1, N) AoI in slots.
    pub aoi: Vec<f32>,
    /// (B, K, M) heading indices.
    pub actions: Vec<u8>,
    /// (B, K) rewards.
    pub reward: Vec<f32>,
    /// (B, M, 4) identity tokens, drawn per episode.
    pub identity_token: Vec<f32>,
}

/// A symmetry of the square: optionally mirrored left to right, then rotated counter-clockwise by quarter turns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Symmetry {
    mirror: bool,
    quarters: u8,
}

impl Symmetry {
    /// Number of symmetries.
    pub const COUNT: u8 = 8;

    /// The symmetry of index `i`, from 0 (the identity) to 7.
    pub fn from_index(i: u8) -> Self {
        Self { mirror: i & 4 != 0, quarters: i & 3 }
    }

    /// The image of a point.
    fn point(self, [x, y]: [f32; 2]) -> [f32; 2] {
        let x = if self.mirror { 1.0 - x } else { x };
        match self.quarters {
            0 => [x, y],
            1 => [1.0 - y, x],
            2 => [1.0 - x, 1.0 - y],
            _ => [y, 1.0 - x],
        }
    }

    /// The image of a heading; hovering is unchanged.
    fn heading(self, h: u8) -> u8 {
        const COMPASS: u8 = EnvConfig::COMPASS as u8;
        if h >= COMPASS {
            return h;
        }
        let h = if self.mirror { COMPASS + COMPASS / 2 - h } else { h };
        (h + COMPASS / 4 * self.quarters) % COMPASS
    }
}

impl Episodes {
    /// Rotates and mirrors positions and headings of each episode by its symmetry.
    ///
    /// # Panics
    /// If there is not one symmetry per episode.
    pub fn transform(&mut self, symmetries: &[Symmetry]) {
        assert_eq!(symmetries.len(), self.len, "one symmetry per episode");
        let points = |xy: &mut [f32], s: Symmetry| {
            xy.as_chunks_mut().0.iter_mut().for_each(|p| *p = s.point(*p));
        };
        let len_per_episode = |len: usize| len / self.len;
        let (uavs, users, actions) =
            (len_per_episode(self.uav_xy.len()), len_per_episode(self.user_xy.len()), len_per_episode(self.actions.len()));
        for (e, &s) in symmetries.iter().enumerate() {
            points(&mut self.uav_xy[e * uavs..][..uavs], s);
            points(&mut self.user_xy[e * users..][..users], s);
            self.actions[e * actions..][..actions].iter_mut().for_each(|h| *h = s.heading(*h));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::env::DIRECTIONS;

    #[test]
    fn headings_rotate_with_positions() {
        let middle = [0.5, 0.5];
        for s in (0..Symmetry::COUNT).map(Symmetry::from_index) {
            assert_eq!(s.point(middle), middle);
            assert_eq!(s.heading(8), 8, "hovering is unchanged");
            for (h, d) in DIRECTIONS.iter().take(EnvConfig::COMPASS).enumerate() {
                let moved = s.point([0.5 + 0.25 * d[0] as f32, 0.5 + 0.25 * d[1] as f32]);
                let d = DIRECTIONS[s.heading(h as u8) as usize];
                let expected = [0.5 + 0.25 * d[0] as f32, 0.5 + 0.25 * d[1] as f32];
                assert!(moved.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{s:?}, heading {h}");
            }
        }
        let images: std::collections::BTreeSet<_> =
            (0..8).map(|i| Symmetry::from_index(i).point([0.25, 0.125]).map(f32::to_bits)).collect();
        assert_eq!(images.len(), 8, "eight different symmetries");
    }
}
