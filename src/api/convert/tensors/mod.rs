//! Tensors: names, datatypes, shapes and values as the Open Inference Protocol writes them, read with every size checked
//! before memory is taken.
//!
//! A value is little-endian, tensors are row by row, and an element of BYTES is preceded by its length in 4 bytes.

mod observation;

use std::fmt;

use bytes::{Buf, BufMut, Bytes, BytesMut};

use crate::invalid::Invalid;

pub use observation::{Dimension, INPUTS, observation, weight};

/// Datatypes that are spoken here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Datatype {
    /// Whole numbers of 32 bits.
    Int32,
    /// Whole numbers of 64 bits.
    Int64,
    /// Numbers of 32 bits.
    Fp32,
    /// Numbers of 64 bits.
    Fp64,
    /// Strings of bytes.
    Bytes,
}

impl Datatype {
    const ALL: [Self; 5] = [Self::Int32, Self::Int64, Self::Fp32, Self::Fp64, Self::Bytes];

    /// As the protocol writes it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Int32 => "INT32",
            Self::Int64 => "INT64",
            Self::Fp32 => "FP32",
            Self::Fp64 => "FP64",
            Self::Bytes => "BYTES",
        }
    }

    /// The datatype called `name`, if it is spoken here.
    pub fn parse(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|datatype| datatype.name() == name)
    }

    /// Bytes of an element, at least.
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

/// A tensor as it was sent: nothing about it has been checked.
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
    /// Whether a request may lack it.
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
    fn wrong(&self, part: &str, value: impl fmt::Display, expected: impl Into<String>) -> Invalid {
        Invalid::new(format!("{}{part}", self.name), value, expected)
    }

    fn wrong_shape(&self, expected: &str) -> Invalid {
        self.wrong(".shape", format!("{:?}", self.shape), expected)
    }

    /// The size of the first of the dimensions `expected`, the others of which are `inner`; at most `most`.
    fn rows(&self, expected: &str, inner: &[i64], most: usize) -> Result<usize, Invalid> {
        let (first, rest) = self.shape.split_first().ok_or_else(|| self.wrong_shape(expected))?;
        let rows = usize::try_from(*first).ok().filter(|_| rest == inner).ok_or_else(|| self.wrong_shape(expected))?;
        if rows > most {
            return Err(self.wrong_shape(&format!("{expected}, the first of which is at most {most}")));
        }
        Ok(rows)
    }

    /// The one of `allowed` that the tensor is of.
    fn check_datatype(&self, allowed: &[Datatype]) -> Result<Datatype, Invalid> {
        let found = Datatype::parse(&self.datatype).filter(|datatype| allowed.contains(datatype));
        let names = || allowed.iter().map(|datatype| datatype.name()).collect::<Vec<_>>().join(" or ");
        let datatype = found.ok_or_else(|| self.wrong(".datatype", format!("{:?}", self.datatype), names()))?;
        match self.data.datatype() {
            Some(other) if other != datatype => {
                Err(self.wrong("", format!("values of {other}"), format!("values of {datatype}, the datatype of the tensor")))
            }
            _ => Ok(datatype),
        }
    }

    fn check_len(&self, len: usize, count: usize) -> Result<(), Invalid> {
        if len == count {
            return Ok(());
        }
        Err(self.wrong("", format!("{len} values"), format!("{count} values for the shape {:?}", self.shape)))
    }

    /// `count` elements of raw values of a fixed size.
    fn check_raw<'a>(&self, raw: &'a Bytes, datatype: Datatype, count: usize) -> Result<&'a [u8], Invalid> {
        if Some(raw.len()) == count.checked_mul(datatype.size()) {
            return Ok(raw);
        }
        let expected = format!("{count} values of {} bytes for the shape {:?}", datatype.size(), self.shape);
        Err(self.wrong("", format!("{} bytes", raw.len()), expected))
    }

    /// `count` numbers of FP32 or FP64, not necessarily finite.
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

    /// `count` whole numbers of INT32 or INT64.
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

    /// `count` strings of bytes.
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

    /// Cuts raw BYTES into `count` elements.
    fn split(&self, mut raw: Bytes, count: usize) -> Result<Vec<Bytes>, Invalid> {
        let size = raw.len();
        let wrong = |place: usize, left: usize| {
            let value = format!("{size} bytes, {left} of them for element {place}");
            self.wrong("", value, format!("{count} elements, each preceded by its length in 4 bytes"))
        };
        // Four bytes are the least that an element takes: nothing is reserved for elements that cannot be there.
        if count.checked_mul(4).is_none_or(|least| least > size) {
            return Err(wrong(size / 4, size % 4));
        }
        let mut elements = Vec::with_capacity(count);
        for place in 0..count {
            let left = raw.len();
            let len = raw.try_get_u32_le().map_err(|_| wrong(place, left))? as usize;
            if len > raw.len() {
                return Err(wrong(place, left));
            }
            elements.push(raw.split_to(len));
        }
        if raw.is_empty() { Ok(elements) } else { Err(wrong(count, raw.len())) }
    }

    /// The one element of a BYTES tensor of shape [1]; empty where the tensor is.
    ///
    /// # Errors
    /// Another datatype or shape, or bytes that are not such an element.
    pub fn one_byte_string(&self) -> Result<Bytes, Invalid> {
        let count = self.rows("[1]", &[], 1)?;
        Ok(self.byte_strings(count)?.pop().unwrap_or_default())
    }
}
