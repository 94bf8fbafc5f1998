//! Activations of many samples. The storage is nalgebra's, which is column-major: one column per sample, so that a sample is
//! contiguous. ARCHITECTURE.md says why products are not nalgebra's.

use std::ops::Range;

use nalgebra::DMatrix;

use super::real::Real;
use super::simd::simd;

/// Activations: `width` numbers for each of `len` samples. Resizing keeps the allocation.
#[derive(Clone, Debug)]
pub struct Batch<T: Real>(DMatrix<T>);

impl<T: Real> Default for Batch<T> {
    fn default() -> Self {
        Self(DMatrix::from_vec(0, 0, Vec::new()))
    }
}

/// A view of samples: sample i starts at `data[i * stride]`. The width is known from the context.
#[derive(Clone, Copy, Debug)]
pub struct Rows<'a, T> {
    /// From the first number of the first sample on.
    pub data: &'a [T],
    /// Distance between the starts of samples.
    pub stride: usize,
    /// Number of samples.
    pub len: usize,
}

/// A mutable view of samples.
#[derive(Debug)]
pub struct RowsMut<'a, T> {
    /// From the first number of the first sample on.
    pub data: &'a mut [T],
    /// Distance between the starts of samples.
    pub stride: usize,
    /// Number of samples.
    pub len: usize,
}

impl<T> Rows<'_, T> {
    /// The same samples without their first `from` numbers.
    #[must_use]
    pub fn from_column(self, from: usize) -> Self {
        Self { data: &self.data[from.min(self.data.len())..], ..self }
    }
}

impl<T: Real> Batch<T> {
    /// Changes the shape. The content is unspecified afterwards.
    pub fn reset(&mut self, width: usize, len: usize) {
        if (self.0.nrows(), self.0.ncols()) != (width, len) {
            let mut data: Vec<T> = std::mem::take(self).0.data.into();
            data.resize(width * len, T::ZERO);
            self.0 = DMatrix::from_vec(width, len, data);
        }
    }

    /// Changes the shape and sets all numbers to 0.
    pub fn reset_zero(&mut self, width: usize, len: usize) {
        self.reset(width, len);
        self.as_mut_slice().fill(T::ZERO);
    }

    /// Numbers per sample.
    pub fn width(&self) -> usize {
        self.0.nrows()
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        self.0.ncols()
    }

    /// Whether there are no numbers.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// All numbers, sample by sample.
    pub fn as_slice(&self) -> &[T] {
        self.0.as_slice()
    }

    /// All numbers, sample by sample.
    pub fn as_mut_slice(&mut self) -> &mut [T] {
        self.0.as_mut_slice()
    }

    /// Sample i.
    pub fn row(&self, i: usize) -> &[T] {
        let w = self.width();
        &self.0.as_slice()[i * w..(i + 1) * w]
    }

    /// Sample i.
    pub fn row_mut(&mut self, i: usize) -> &mut [T] {
        let w = self.width();
        &mut self.0.as_mut_slice()[i * w..(i + 1) * w]
    }

    /// All samples.
    pub fn rows(&self) -> Rows<'_, T> {
        Rows { data: self.as_slice(), stride: self.width(), len: self.len() }
    }

    /// All samples.
    pub fn rows_mut(&mut self) -> RowsMut<'_, T> {
        let (stride, len) = (self.width(), self.len());
        RowsMut { data: self.as_mut_slice(), stride, len }
    }

    /// Samples `range`.
    pub fn range(&self, range: Range<usize>) -> Rows<'_, T> {
        let w = self.width();
        Rows { data: &self.as_slice()[range.start * w..range.end * w], stride: w, len: range.len() }
    }

    /// Samples `range`.
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
