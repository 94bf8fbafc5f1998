//! The ground that a UAV has not searched, in blocks.

use std::sync::LazyLock;

use super::super::fleet_profile::{Sector, direction};
use super::super::memory::{GRID, UavMemory};
use super::{BLOCKS, MAX_BLOCKS};

/// Cells along each side of a block.
const SIDE: usize = GRID / BLOCKS;
/// A coordinate that is out of range of everything.
const FAR: f64 = 1e9;

/// The ground that was not searched, by block.
#[derive(Clone, Debug)]
pub(super) struct Ground {
    /// The searched cells of each row of cells.
    searched: [u32; GRID],
    /// Unsearched cells per block.
    pub(super) cells: [u32; MAX_BLOCKS],
    /// Mean x and mean y of these cells; far away without any.
    pub(super) centers: [[f64; MAX_BLOCKS]; 2],
    /// Direction of that place.
    directions: [f64; MAX_BLOCKS],
    /// Unsearched cells of all blocks.
    pub(super) unsearched: u32,
}

impl Ground {
    fn new(searched: [u32; GRID]) -> Self {
        let mut ground = Self { searched, cells: [0; _], centers: [[FAR; _]; _], directions: [0.0; _], unsearched: 0 };
        for row in 0..BLOCKS {
            for column in 0..BLOCKS {
                let (mut count, mut columns, mut rows) = (0, 0, 0);
                for (r, searched) in searched[SIDE * row..][..SIDE].iter().enumerate() {
                    let side = (!searched >> (SIDE * column)) as usize % (1 << SIDE);
                    count += BITS[side][0];
                    columns += BITS[side][1];
                    rows += r as u32 * BITS[side][0];
                }
                if count > 0 {
                    let block = row * BLOCKS + column;
                    ground.cells[block] = count;
                    ground.unsearched += count;
                    let whole = count == (SIDE * SIDE) as u32;
                    let at = [
                        center(columns + (SIDE * column) as u32 * count, count),
                        center(rows + (SIDE * row) as u32 * count, count),
                    ];
                    [ground.centers[0][block], ground.centers[1][block]] = at;
                    ground.directions[block] = if whole { WHOLE[block] } else { direction(at) };
                }
            }
        }
        ground
    }

    /// The blocks with unsearched cells.
    pub(super) fn blocks(&self) -> impl Iterator<Item = usize> + '_ {
        (0..MAX_BLOCKS).filter(|&block| self.cells[block] > 0)
    }

    /// Whether the centre of a block is in the sector of this UAV.
    pub(super) fn is_owned(&self, block: usize, sector: &Sector) -> bool {
        sector.owns_direction(self.directions[block])
    }
}

/// Places in [`RecentGround`].
const RECENT: usize = 64;

/// The ground of recent rows. What a UAV has searched changes in few slots.
#[derive(Clone, Debug)]
pub(super) struct RecentGround(Vec<Ground>);

impl Default for RecentGround {
    fn default() -> Self {
        Self(vec![Ground::new([0; _]); RECENT])
    }
}

impl RecentGround {
    /// The ground of a UAV.
    pub(super) fn of(&mut self, memory: UavMemory<'_>) -> &Ground {
        let searched: [u32; GRID] = std::array::from_fn(|row| memory.searched(row));
        let mix = |hash: u64, &row: &u32| (hash ^ u64::from(row)).wrapping_mul(0x9E37_79B9_7F4A_7C15).rotate_left(29);
        let ground = &mut self.0[searched.iter().fold(0, mix) as usize % RECENT];
        if ground.searched != searched {
            *ground = Ground::new(searched);
        }
        ground
    }
}

/// The mean coordinate of `count` cells, of whose indices `sum` is the sum.
fn center(sum: u32, count: u32) -> f64 {
    (f64::from(sum) / f64::from(count) + 0.5) / GRID as f64
}

/// Directions of the centres of blocks without a searched cell.
static WHOLE: LazyLock<[f64; MAX_BLOCKS]> = LazyLock::new(|| {
    let middle = |k: usize| (k as f64 + 0.5) / BLOCKS as f64;
    std::array::from_fn(|block| direction([middle(block % BLOCKS), middle(block / BLOCKS)]))
});

/// For each set of cells in a row of a block: their number, and the sum of their indices.
const BITS: [[u32; 2]; 1 << SIDE] = {
    let mut bits = [[0; 2]; 1 << SIDE];
    let mut k = 0;
    while k < SIDE << SIDE {
        let (set, index) = (k / SIDE, k % SIDE);
        let bit = (set >> index & 1) as u32;
        bits[set][0] += bit;
        bits[set][1] += bit * index as u32;
        k += 1;
    }
    bits
};

#[cfg(test)]
mod tests {
    use rand::RngExt;

    use super::*;

    #[test]
    fn recent_ground_is_that_of_the_memory_and_counts_its_cells() {
        let mut rng = crate::rng::stream(6, "ground", 0);
        let memories: Vec<[f32; GRID]> =
            (0..3 * RECENT).map(|_| std::array::from_fn(|_| rng.random_range(0..1_u32 << GRID) as f32)).collect();
        let memories: Vec<_> = memories.into_iter().chain([[0.0; GRID]]).collect();
        let mut recent = RecentGround::default();
        // The second time, most places hold the ground of another memory.
        for memory in memories.iter().chain(&memories) {
            let ground = recent.of(UavMemory::new(memory, 0));
            let unsearched = |x: usize, y: usize| memory[y] as u32 >> x & 1 == 0;
            for block in 0..MAX_BLOCKS {
                let [left, bottom] = [block % BLOCKS, block / BLOCKS].map(|k| k * SIDE);
                let cells = (left..left + SIDE).flat_map(|x| (bottom..bottom + SIDE).map(move |y| (x, y)));
                let count = cells.filter(|&(x, y)| unsearched(x, y)).count();
                assert_eq!(ground.cells[block], count as u32);
                if count > 0 {
                    let at = ground.centers.map(|centers| centers[block]);
                    assert_eq!(ground.directions[block].to_bits(), direction(at).to_bits());
                }
            }
            assert_eq!(ground.unsearched, ground.cells.iter().sum::<u32>());
        }
    }
}
