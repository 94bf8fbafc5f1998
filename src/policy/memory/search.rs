//! The search of the ground: which cells of the unit square a UAV has searched since its present search began.
//!
//! Encoding: [`GRID`] rows, each an integer. Bit c is set if the cell in column c was searched; the four bits above the cells hold a part
//! of the slot in which the search began, the lowest part in row 0. f32 holds such integers exactly.

use super::GRID;
use crate::env::Point;
use crate::policy::EnvParams;

/// All cells of a row.
const ALL: u32 = (1 << GRID) - 1;
/// Bits of the slot per row, and rows that hold them.
const SLOT_BITS: usize = 4;
const SLOT_MASK: u32 = (1 << SLOT_BITS) - 1;
const SLOT_ROWS: usize = u32::BITS as usize / SLOT_BITS;

/// The cells of a row that were searched: bit c stands for the cell in column c.
pub(super) fn cells(row: f32) -> u32 {
    row as u32 & ALL
}

/// Number of cells that were searched.
pub(super) fn count(ground: &[f32]) -> usize {
    ground.iter().map(|&row| cells(row).count_ones() as usize).sum()
}

/// Whether all cells were searched.
pub(super) fn is_complete(ground: &[f32]) -> bool {
    ground.iter().all(|&row| cells(row) == ALL)
}

/// Slot in which the search began.
pub(super) fn began(ground: &[f32]) -> u32 {
    ground[..SLOT_ROWS].iter().rev().fold(0, |slot, &row| slot << SLOT_BITS | (row as u32 >> GRID) & SLOT_MASK)
}

/// Begins a new search in slot `slot`.
pub(super) fn begin(slot: u64, ground: &mut [f32]) {
    let slot = u32::try_from(slot).unwrap_or(u32::MAX);
    ground.fill(0.0);
    for (k, row) in ground[..SLOT_ROWS].iter_mut().enumerate() {
        *row = ((slot >> (SLOT_BITS * k) & SLOT_MASK) << GRID) as f32;
    }
}

/// Marks cells, given per row, as searched.
pub(super) fn mark(marked: &[u32; GRID], ground: &mut [f32]) {
    for (row, marked) in ground.iter_mut().zip(marked) {
        *row = (*row as u32 | marked) as f32;
    }
}

/// Adds what another UAV searched. Of two searches, the one that began later counts.
pub(super) fn merge(other: &[f32], ground: &mut [f32]) {
    let (mine, theirs) = (began(ground), began(other));
    if theirs > mine {
        ground.copy_from_slice(other);
    } else if theirs == mine {
        ground.iter_mut().zip(other).for_each(|(row, &other)| *row = (*row as u32 | other as u32) as f32);
    }
}

/// Marks the cells whose centres are within `range` of `at` as searched.
#[inline(always)]
pub(super) fn search(at: Point, range: f64, ground: &mut [f32]) {
    let side = GRID as f64;
    let first = ((at[1] - range) * side - 0.5).ceil().max(0.0) as usize;
    let end = ((at[1] + range) * side + 0.5).floor().clamp(0.0, side) as usize;
    for (row, bits) in ground.iter_mut().enumerate().take(end).skip(first) {
        let dy = (row as f64 + 0.5) / side - at[1];
        let half = (range * range - dy * dy).max(0.0).sqrt();
        let left = ((at[0] - half) * side - 0.5).ceil().clamp(0.0, side) as u32;
        let right = ((at[0] + half) * side + 0.5).floor().clamp(0.0, side) as u32;
        if left < right {
            let seen = (ALL >> (GRID as u32 - (right - left))) << left;
            *bits = (*bits as u32 | seen) as f32;
        }
    }
}

/// The cells outside the area, per row: nothing is there.
pub(super) fn cells_outside(env: &EnvParams) -> [u32; GRID] {
    if env.extent == [1.0; 2] {
        return [0; GRID];
    }
    let center = |k: usize| (k as f64 + 0.5) / GRID as f64;
    let outside = |row: usize, column: usize| !env.contains([center(column), center(row)]);
    std::array::from_fn(|row| (0..GRID).filter(|&column| outside(row, column)).fold(0, |bits, column| bits | 1 << column))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_searched_when_their_centres_are_in_range() {
        for (at, range) in [
            ([0.5, 0.5], 0.28),
            ([0.0, 1.0], 0.28),
            ([0.013, 0.77], 0.05),
            ([0.3, 0.3], 0.01),
            ([0.4, 0.9], 2.0),
            ([-0.5, 0.5], 0.2),
        ] {
            let mut ground = [0.0; GRID];
            search(at, range, &mut ground);
            for (row, &bits) in ground.iter().enumerate() {
                for column in 0..GRID {
                    let center = [column, row].map(|c| (c as f64 + 0.5) / GRID as f64);
                    let inside = (center[0] - at[0]).powi(2) + (center[1] - at[1]).powi(2) <= range * range;
                    assert_eq!(bits as u32 >> column & 1 == 1, inside, "{at:?}, {range}, cell {column}, {row}");
                }
            }
        }
    }

    #[test]
    fn the_slot_in_which_a_search_began_is_kept_beside_its_cells() {
        for slot in [0, 1, 200, 0x1234_5678, u64::from(u32::MAX), u64::MAX] {
            let mut ground = [7.0; GRID];
            begin(slot, &mut ground);
            assert_eq!((began(&ground), count(&ground)), (slot.min(u32::MAX.into()) as u32, 0));
            search([0.5, 0.5], 2.0, &mut ground);
            assert!(is_complete(&ground));
            assert_eq!(u64::from(began(&ground)), slot.min(u32::MAX.into()));
        }
    }

    #[test]
    fn of_two_searches_the_later_one_counts() {
        let searched = |slot, at| {
            let mut ground = [0.0; GRID];
            begin(slot, &mut ground);
            search(at, 0.3, &mut ground);
            ground
        };
        let merged = |mut ground: [f32; GRID], other: [f32; GRID]| {
            merge(&other, &mut ground);
            ground
        };
        let (early, late) = (searched(3, [0.2, 0.2]), searched(21, [0.8, 0.8]));
        assert_eq!(merged(early, late), late);
        assert_eq!(merged(late, early), late);
        let both = merged(late, searched(21, [0.2, 0.8]));
        assert_eq!(began(&both), 21);
        assert!((0..GRID).all(|row| cells(both[row]) == cells(late[row]) | cells(searched(0, [0.2, 0.8])[row])));
    }
}
