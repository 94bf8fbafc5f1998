//! Episodes in their compact form (spec 5): what replay holds and an update reads. Features are recomputed, never stored.

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
