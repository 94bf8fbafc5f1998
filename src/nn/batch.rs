//! Activations of many samples. A row is one sample, and the numbers of a row are contiguous. ARCHITECTURE.md says why products are
//! not computed by nalgebra.

use std::ops::Range;

use nalgebra::DMatrix;

use super::real::Real;
use super::simd::simd;

/// Activations: `len` rows of `width` numbers. Resizing keeps the allocation.
#[derive(Clone, Debug)]
pub struct Batch<T: Real>(
    // nalgebra stores matrices by column, so a row of the batch is a column of the matrix.
    DMatrix<T>,
);

impl<T: Real> Default for Batch<T> {
    fn default() -> Self {
        Self(DMatrix::from_vec(0, 0, Vec::new()))
    }
}

/// A view of rows: row i starts at `data[i * stride]`. The width is known from the context.
#[derive(Clone, Copy, Debug)]
pub struct Rows<'a, T> {
    /// From the first number of the first row on.
    pub data: &'a [T],
    /// Distance between the starts of rows.
    pub stride: usize,
    /// Number of rows.
    pub len: usize,
}

/// A mutable view of rows.
#[derive(Debug)]
pub struct RowsMut<'a, T> {
    /// From the first number of the first row on.
    pub data: &'a mut [T],
    /// Distance between the starts of rows.
    pub stride: usize,
    /// Number of rows.
    pub len: usize,
}

impl<'a, T> Rows<'a, T> {
    /// The rows in parts of `len` rows; the last part may be shorter.
    pub fn parts(self, len: usize) -> impl Iterator<Item = Rows<'a, T>> {
        let Self { data, stride, len: rows } = self;
        (0..rows).step_by(len).map(move |first| Rows { data: &data[first * stride..], stride, len: len.min(rows - first) })
    }

    /// The same rows without their first `from` numbers.
    #[must_use]
    pub fn from_column(self, from: usize) -> Self {
        Self { data: &self.data[from.min(self.data.len())..], ..self }
    }
}

impl<'a, T> RowsMut<'a, T> {
    /// The rows in parts of `len` rows; the last part may be shorter.
    pub fn parts(self, len: usize) -> impl Iterator<Item = RowsMut<'a, T>> {
        let Self { data, stride, len: rows } = self;
        let data = data.chunks_mut(len * stride.max(1));
        data.zip((0..rows).step_by(len)).map(move |(data, first)| RowsMut { data, stride, len: len.min(rows - first) })
    }
}

impl<T: Real> Batch<T> {
    /// Changes the shape. Afterwards the numbers are arbitrary: the caller overwrites them.
    pub fn resize(&mut self, width: usize, len: usize) {
        if (self.0.nrows(), self.0.ncols()) != (width, len) {
            let mut data: Vec<T> = std::mem::take(self).0.data.into();
            data.resize(width * len, T::ZERO);
            self.0 = DMatrix::from_vec(width, len, data);
        }
    }

    /// Changes the shape and sets all numbers to 0.
    pub fn resize_zero(&mut self, width: usize, len: usize) {
        self.resize(width, len);
        self.as_mut_slice().fill(T::ZERO);
    }

    /// Numbers per row.
    pub fn width(&self) -> usize {
        self.0.nrows()
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.0.ncols()
    }

    /// Whether there are no numbers.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// All numbers, row by row.
    pub fn as_slice(&self) -> &[T] {
        self.0.as_slice()
    }

    /// All numbers, row by row.
    pub fn as_mut_slice(&mut self) -> &mut [T] {
        self.0.as_mut_slice()
    }

    /// Row i.
    pub fn row(&self, i: usize) -> &[T] {
        let w = self.width();
        &self.0.as_slice()[i * w..(i + 1) * w]
    }

    /// Row i.
    pub fn row_mut(&mut self, i: usize) -> &mut [T] {
        let w = self.width();
        &mut self.0.as_mut_slice()[i * w..(i + 1) * w]
    }

    /// All rows.
    pub fn rows(&self) -> Rows<'_, T> {
        Rows { data: self.as_slice(), stride: self.width(), len: self.len() }
    }

    /// All rows.
    pub fn rows_mut(&mut self) -> RowsMut<'_, T> {
        let (stride, len) = (self.width(), self.len());
        RowsMut { data: self.as_mut_slice(), stride, len }
    }

    /// Rows `range`.
    pub fn range(&self, range: Range<usize>) -> Rows<'_, T> {
        let w = self.width();
        Rows { data: &self.as_slice()[range.start * w..range.end * w], stride: w, len: range.len() }
    }

    /// Rows `range`.
    pub fn range_mut(&mut self, range: Range<usize>) -> RowsMut<'_, T> {
        let w = self.width();
        RowsMut { stride: w, len: range.len(), data: &mut self.as_mut_slice()[range.start * w..range.end * w] }
    }
}

/// Adds every row of `rows` to `sums`; rows and `sums` have the same width.
pub(super) fn add_rows<T: Real>(rows: Rows<'_, T>, sums: &mut [T]) {
    let width = sums.len();
    simd(
        #[inline(always)]
        || {
            for row in rows.data.chunks(rows.stride.max(1)).take(rows.len) {
                sums.iter_mut().zip(&row[..width]).for_each(|(s, &x)| *s += x);
            }
        },
    );
}
