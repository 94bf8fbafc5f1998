//! The ground that a UAV has not searched, in blocks.

use std::sync::LazyLock;

use super::super::fleet_profile::{Place, direction};
use super::super::memory::{GRID, UavMemory};
use super::{BLOCKS, MAX_BLOCKS};
use crate::env::Point;

/// Cells along each side of a block.
const SIDE: usize = GRID / BLOCKS;
/// A coordinate that is out of range of everything.
const FAR: f64 = 1e9;

/// The ground that was not searched, by block.
pub(super) struct Ground {
    /// Unsearched cells per block.
    pub(super) cells: [u32; MAX_BLOCKS],
    /// Mean x and mean y of these cells; far away without any.
    pub(super) centers: [[f64; MAX_BLOCKS]; 2],
    /// Unsearched cells of all blocks.
    pub(super) unsearched: u32,
}

impl Ground {
    pub(super) fn new(memory: UavMemory<'_>) -> Self {
        let mut ground = Self { cells: [0; _], centers: [[FAR; _]; _], unsearched: 0 };
        for row in 0..BLOCKS {
            let cells: [u32; SIDE] = std::array::from_fn(|r| !memory.searched(SIDE * row + r));
            for column in 0..BLOCKS {
                let (mut count, mut columns, mut rows) = (0, 0, 0);
                for (r, cells) in cells.iter().enumerate() {
                    let side = (cells >> (SIDE * column)) as usize % (1 << SIDE);
                    count += BITS[side][0];
                    columns += BITS[side][1];
                    rows += r as u32 * BITS[side][0];
                }
                if count > 0 {
                    let block = row * BLOCKS + column;
                    ground.cells[block] = count;
                    ground.unsearched += count;
                    ground.centers[0][block] = center(columns + (SIDE * column) as u32 * count, count);
                    ground.centers[1][block] = center(rows + (SIDE * row) as u32 * count, count);
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
    pub(super) fn is_owned(&self, block: usize, place: &Place) -> bool {
        /// Directions of the centres of blocks without a searched cell.
        static WHOLE: LazyLock<[f64; MAX_BLOCKS]> = LazyLock::new(|| {
            let whole = Ground::new(UavMemory::EMPTY);
            std::array::from_fn(|block| direction(whole.center(block)))
        });
        let whole = self.cells[block] == (SIDE * SIDE) as u32;
        place.owns_direction(if whole { WHOLE[block] } else { direction(self.center(block)) })
    }

    fn center(&self, block: usize) -> Point {
        self.centers.map(|centers| centers[block])
    }
}

/// The mean coordinate of `count` cells, of whose indices `sum` is the sum.
fn center(sum: u32, count: u32) -> f64 {
    (f64::from(sum) / f64::from(count) + 0.5) / GRID as f64
}

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
