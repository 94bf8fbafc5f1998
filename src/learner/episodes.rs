//! Episodes in their compact form (spec 5): what replay holds and an update reads. Features are recomputed, never stored.

use crate::env::EnvConfig;

/// A batch of B episodes of equal size, structure of arrays. Positions are f32: what is stored is exactly what was seen.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Episodes {
    /// B.
    pub len: usize,
    /// M, N, K.
    pub uavs: usize,
    /// N.
    pub users: usize,
    /// K.
    pub slots: usize,
    /// (B, K+1, M, 2) UAV positions.
    pub uav_xy: Vec<f32>,
    /// (B, S, N, 2) user positions; S = 1 when users stay, K+1 when they move.
    pub user_xy: Vec<f32>,
    /// Whether users move: S = K+1.
    pub users_move: bool,
    /// (B, K+1, N) AoI in slots.
    pub aoi: Vec<f32>,
    /// (B, K, M) heading indices.
    pub actions: Vec<u8>,
    /// (B, K) rewards.
    pub reward: Vec<f32>,
    /// (B, M, 4) identity tokens, drawn per episode.
    pub token: Vec<f32>,
}

/// A symmetry of the square: mirrored left to right or not, then turned by quarters counter-clockwise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Symmetry {
    mirror: bool,
    quarters: u8,
}

impl Symmetry {
    /// How many there are.
    pub const COUNT: u8 = 8;

    /// Symmetry number 0 (the identity) to 7.
    pub fn number(i: u8) -> Self {
        Self { mirror: i & 4 != 0, quarters: i & 3 }
    }

    /// Where a point of the square goes.
    fn point(self, [x, y]: [f32; 2]) -> [f32; 2] {
        let x = if self.mirror { 1.0 - x } else { x };
        match self.quarters {
            0 => [x, y],
            1 => [1.0 - y, x],
            2 => [1.0 - x, 1.0 - y],
            _ => [y, 1.0 - x],
        }
    }

    /// What a heading becomes; hovering stays.
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
    /// Turns and mirrors each episode by its own symmetry: what another fleet in a square laid otherwise would have flown.
    ///
    /// # Panics
    /// When there is not one symmetry per episode.
    pub fn transform(&mut self, symmetries: &[Symmetry]) {
        assert_eq!(symmetries.len(), self.len, "one symmetry per episode");
        let points = |xy: &mut [f32], s: Symmetry| {
            xy.as_chunks_mut().0.iter_mut().for_each(|p| *p = s.point(*p));
        };
        let share = |len: usize| len / self.len;
        let (uavs, users, actions) = (share(self.uav_xy.len()), share(self.user_xy.len()), share(self.actions.len()));
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
    fn headings_turn_with_the_square() {
        let middle = [0.5, 0.5];
        for s in (0..Symmetry::COUNT).map(Symmetry::number) {
            assert_eq!(s.point(middle), middle);
            assert_eq!(s.heading(8), 8, "hovering stays");
            for (h, d) in DIRECTIONS.iter().take(EnvConfig::COMPASS).enumerate() {
                let moved = s.point([0.5 + 0.25 * d[0] as f32, 0.5 + 0.25 * d[1] as f32]);
                let d = DIRECTIONS[s.heading(h as u8) as usize];
                let expected = [0.5 + 0.25 * d[0] as f32, 0.5 + 0.25 * d[1] as f32];
                assert!(moved.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{s:?}, heading {h}");
            }
        }
        let images: std::collections::BTreeSet<_> =
            (0..8).map(|i| Symmetry::number(i).point([0.25, 0.125]).map(f32::to_bits)).collect();
        assert_eq!(images.len(), 8, "eight different symmetries");
    }
}
