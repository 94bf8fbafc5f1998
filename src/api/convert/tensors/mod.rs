//! Tensors of the Open Inference Protocol: names, datatypes, shapes and values. Every size is checked before memory is allocated.
//!
//! Values are little-endian, in row-major order. An element of BYTES is preceded by its length in 4 bytes.

mod fleet_input;

use std::fmt;

use bytes::{Buf, BufMut, Bytes, BytesMut};

use crate::invalid::Invalid;

pub use fleet_input::{Dimension, INPUTS, element_count, fleet_input};

/// The supported datatypes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Datatype {
    /// Signed integers of 32 bits.
    Int32,
    /// Signed integers of 64 bits.
    Int64,
    /// Floating-point numbers of 32 bits.
    Fp32,
    /// Floating-point numbers of 64 bits.
    Fp64,
    /// Byte strings.
    Bytes,
}

impl Datatype {
    const ALL: [Self; 5] = [Self::Int32, Self::Int64, Self::Fp32, Self::Fp64, Self::Bytes];

    /// The name in the protocol.
    pub fn name(self) -> &'static str {
        match self {
            Self::Int32 => "INT32",
            Self::Int64 => "INT64",
            Self::Fp32 => "FP32",
            Self::Fp64 => "FP64",
            Self::Bytes => "BYTES",
        }
    }

    /// The datatype called `name`, if it is supported.
    pub fn parse(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|datatype| datatype.name() == name)
    }

    /// Minimum number of bytes of an element.
    fn size(self) -> usize {
        match self {
            Self::Int32 | Self::Fp32 | Self::Bytes => 4,
            Self::Int64 | Self::Fp64 => 8,
        }
    }
}

impl fmt::Display for Datatype {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A tensor as the client sent it, unchecked.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Name.
    pub name: String,
    /// Datatype.
    pub datatype: String,
    /// Shape.
    pub shape: Vec<i64>,
    /// Values.
    pub data: Data,
}

/// A tensor without its values.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TensorShape {
    /// Name.
    pub name: &'static str,
    /// Datatype.
    pub datatype: Datatype,
    /// -1: any size.
    pub shape: Vec<i64>,
    /// Whether a request may omit the tensor.
    pub optional: bool,
}

/// Values of a tensor.
#[derive(Clone, Debug, PartialEq)]
pub enum Data {
    /// As bytes.
    Raw(Bytes),
    /// INT32.
    Int32(Vec<i32>),
    /// INT64.
    Int64(Vec<i64>),
    /// FP32.
    Fp32(Vec<f32>),
    /// FP64.
    Fp64(Vec<f64>),
    /// BYTES.
    Bytes(Vec<Bytes>),
}

impl Data {
    /// The datatype of typed values.
    pub fn datatype(&self) -> Option<Datatype> {
        match self {
            Self::Raw(_) => None,
            Self::Int32(_) => Some(Datatype::Int32),
            Self::Int64(_) => Some(Datatype::Int64),
            Self::Fp32(_) => Some(Datatype::Fp32),
            Self::Fp64(_) => Some(Datatype::Fp64),
            Self::Bytes(_) => Some(Datatype::Bytes),
        }
    }

    /// The values as bytes.
    pub fn into_raw(self) -> Bytes {
        fn put<T>(values: Vec<T>, size: usize, put: impl Fn(&mut BytesMut, T)) -> Bytes {
            let mut raw = BytesMut::with_capacity(size * values.len());
            values.into_iter().for_each(|value| put(&mut raw, value));
            raw.freeze()
        }
        match self {
            Self::Raw(raw) => raw,
            Self::Int32(values) => put(values, 4, BytesMut::put_i32_le),
            Self::Int64(values) => put(values, 8, BytesMut::put_i64_le),
            Self::Fp32(values) => put(values, 4, BytesMut::put_f32_le),
            Self::Fp64(values) => put(values, 8, BytesMut::put_f64_le),
            Self::Bytes(values) => {
                let size = values.iter().map(|value| 4 + value.len()).sum();
                let mut raw = BytesMut::with_capacity(size);
                for value in values {
                    raw.put_u32_le(value.len() as u32);
                    raw.put(value);
                }
                raw.freeze()
            }
        }
    }
}

impl Tensor {
    fn invalid(&self, part: &str, value: impl fmt::Display, expected: impl Into<String>) -> Invalid {
        Invalid::new(format!("{}{part}", self.name), value, expected)
    }

    fn invalid_shape(&self, expected: &str) -> Invalid {
        self.invalid(".shape", format!("{:?}", self.shape), expected)
    }

    /// The first dimension of a tensor, at most `max`. Checks that the other dimensions are `inner`. `expected` describes the
    /// shape in errors.
    fn rows(&self, expected: &str, inner: &[i64], max: usize) -> Result<usize, Invalid> {
        let (first, rest) = self.shape.split_first().ok_or_else(|| self.invalid_shape(expected))?;
        let rows = usize::try_from(*first).ok().filter(|_| rest == inner).ok_or_else(|| self.invalid_shape(expected))?;
        if rows > max {
            return Err(self.invalid_shape(&format!("{expected}, the first dimension at most {max}")));
        }
        Ok(rows)
    }

    /// The datatype of the tensor. Checks that it is one of `allowed`.
    fn check_datatype(&self, allowed: &[Datatype]) -> Result<Datatype, Invalid> {
        let found = Datatype::parse(&self.datatype).filter(|datatype| allowed.contains(datatype));
        let names = || allowed.iter().map(|datatype| datatype.name()).collect::<Vec<_>>().join(" or ");
        let datatype = found.ok_or_else(|| self.invalid(".datatype", format!("{:?}", self.datatype), names()))?;
        match self.data.datatype() {
            Some(other) if other != datatype => {
                Err(self.invalid("", format!("values of {other}"), format!("values of {datatype}, the datatype of the tensor")))
            }
            _ => Ok(datatype),
        }
    }

    fn check_len(&self, len: usize, count: usize) -> Result<(), Invalid> {
        if len == count {
            return Ok(());
        }
        Err(self.invalid("", format!("{len} values"), format!("{count} values for the shape {:?}", self.shape)))
    }

    /// Checks that `raw` has `count` elements of a fixed size.
    fn check_raw<'a>(&self, raw: &'a Bytes, datatype: Datatype, count: usize) -> Result<&'a [u8], Invalid> {
        if Some(raw.len()) == count.checked_mul(datatype.size()) {
            return Ok(raw);
        }
        let expected = format!("{count} values of {} bytes for the shape {:?}", datatype.size(), self.shape);
        Err(self.invalid("", format!("{} bytes", raw.len()), expected))
    }

    /// `count` numbers of FP32 or FP64, which may be infinite or NaN.
    fn numbers(&self, count: usize) -> Result<Vec<f64>, Invalid> {
        let datatype = self.check_datatype(&[Datatype::Fp32, Datatype::Fp64])?;
        Ok(match &self.data {
            Data::Fp32(values) => {
                self.check_len(values.len(), count)?;
                values.iter().copied().map(f64::from).collect()
            }
            Data::Fp64(values) => {
                self.check_len(values.len(), count)?;
                values.clone()
            }
            Data::Raw(raw) => {
                let elements = self.check_raw(raw, datatype, count)?.chunks_exact(datatype.size());
                match datatype {
                    Datatype::Fp32 => elements.map(|mut value| f64::from(value.get_f32_le())).collect(),
                    _ => elements.map(|mut value| value.get_f64_le()).collect(),
                }
            }
            _ => Vec::new(),
        })
    }

    /// `count` integers of INT32 or INT64.
    fn integers(&self, count: usize) -> Result<Vec<i64>, Invalid> {
        let datatype = self.check_datatype(&[Datatype::Int32, Datatype::Int64])?;
        Ok(match &self.data {
            Data::Int32(values) => {
                self.check_len(values.len(), count)?;
                values.iter().copied().map(i64::from).collect()
            }
            Data::Int64(values) => {
                self.check_len(values.len(), count)?;
                values.clone()
            }
            Data::Raw(raw) => {
                let elements = self.check_raw(raw, datatype, count)?.chunks_exact(datatype.size());
                match datatype {
                    Datatype::Int32 => elements.map(|mut value| i64::from(value.get_i32_le())).collect(),
                    _ => elements.map(|mut value| value.get_i64_le()).collect(),
                }
            }
            _ => Vec::new(),
        })
    }

    /// `count` byte strings.
    fn byte_strings(&self, count: usize) -> Result<Vec<Bytes>, Invalid> {
        self.check_datatype(&[Datatype::Bytes])?;
        match &self.data {
            Data::Bytes(values) => {
                self.check_len(values.len(), count)?;
                Ok(values.clone())
            }
            Data::Raw(raw) => self.split(raw.clone(), count),
            _ => Ok(Vec::new()),
        }
    }

    /// Splits raw BYTES into `count` elements.
    fn split(&self, mut raw: Bytes, count: usize) -> Result<Vec<Bytes>, Invalid> {
        let size = raw.len();
        let invalid = |place: usize, left: usize| {
            let value = format!("{size} bytes, {left} of them for element {place}");
            self.invalid("", value, format!("{count} elements, each preceded by its length in 4 bytes"))
        };
        // An element takes at least 4 bytes, so this bounds the allocation by the size of the input.
        if count.checked_mul(4).is_none_or(|least| least > size) {
            return Err(invalid(size / 4, size % 4));
        }
        let mut elements = Vec::with_capacity(count);
        for place in 0..count {
            let left = raw.len();
            let len = raw.try_get_u32_le().map_err(|_| invalid(place, left))? as usize;
            if len > raw.len() {
                return Err(invalid(place, left));
            }
            elements.push(raw.split_to(len));
        }
        if raw.is_empty() { Ok(elements) } else { Err(invalid(count, raw.len())) }
    }

    /// The element of a BYTES tensor of shape [1], or an empty one for shape [0].
    ///
    /// # Errors
    /// [`Invalid`] for another datatype or shape, or for bytes that are not such an element.
    pub fn one_byte_string(&self) -> Result<Bytes, Invalid> {
        let count = self.rows("[1]", &[], 1)?;
        Ok(self.byte_strings(count)?.pop().unwrap_or_default())
    }
}
