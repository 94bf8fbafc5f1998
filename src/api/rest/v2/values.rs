//! The values of a tensor in JSON: an array, flat or nested like the shape.

use std::fmt;

use serde::Deserialize;
use serde::de::{DeserializeSeed, Deserializer, Error, SeqAccess, Visitor};

use crate::api::convert::tensors::{Data, Datatype};
use crate::invalid::Invalid;

/// The values of an array in row-major order.
#[derive(Debug, Default)]
pub(super) struct Values {
    numbers: Vec<Number>,
    strings: Vec<String>,
    /// Length of the arrays at each depth, where known.
    sizes: Vec<Option<usize>>,
    /// Whether arrays of one depth differ in length, or values in depth.
    ragged: bool,
    /// Depth of the values.
    depth: Option<usize>,
}

#[derive(Clone, Copy, Debug)]
enum Number {
    Whole(i64),
    Real(f64),
}

impl Number {
    fn real(self) -> f64 {
        match self {
            Self::Whole(value) => value as f64,
            Self::Real(value) => value,
        }
    }

    fn whole(self) -> Option<i64> {
        if let Self::Whole(value) = self { Some(value) } else { None }
    }
}

impl Values {
    /// The values of tensor `name` in its datatype. An unknown datatype is rejected later.
    ///
    /// # Errors
    /// [`Invalid`] for strings among numbers, numbers out of the range of the datatype, or nesting unlike the shape.
    pub(super) fn into_data(self, name: &str, datatype: &str, shape: &[i64]) -> Result<Data, Invalid> {
        let nested: Vec<i64> = self.sizes.iter().map(|size| size.unwrap_or(0) as i64).collect();
        if self.ragged || nested.len() > 1 && nested != shape {
            let found = if self.ragged { "ragged arrays".into() } else { format!("arrays of shape {nested:?}") };
            return Err(Invalid::new(format!("{name}.data"), found, format!("a flat array, or arrays of shape {shape:?}")));
        }
        let Some(datatype) = Datatype::parse(datatype) else { return Ok(Data::Raw(bytes::Bytes::new())) };
        let strings = datatype == Datatype::Bytes;
        if !(if strings { self.numbers.is_empty() } else { self.strings.is_empty() }) {
            let (found, expected) = if strings { ("numbers", "strings") } else { ("strings", "numbers") };
            return Err(Invalid::new(format!("{name}.data"), found, format!("{expected}, because of its datatype")));
        }
        let numbers = self.numbers;
        let out_of_range = |i: usize| {
            Invalid::new(format!("{name}.data[{i}]"), numbers[i].real(), format!("a whole number in the range of {datatype}"))
        };
        let whole = numbers.iter().enumerate().map(|(i, number)| number.whole().ok_or_else(|| out_of_range(i)));
        Ok(match datatype {
            Datatype::Int64 => Data::Int64(whole.collect::<Result<_, _>>()?),
            Datatype::Int32 => {
                let narrow =
                    |(i, value): (usize, Result<i64, _>)| value.and_then(|v| i32::try_from(v).map_err(|_| out_of_range(i)));
                Data::Int32(whole.enumerate().map(narrow).collect::<Result<_, _>>()?)
            }
            Datatype::Fp32 => Data::Fp32(numbers.iter().map(|number| number.real() as f32).collect()),
            Datatype::Fp64 => Data::Fp64(numbers.iter().map(|number| number.real()).collect()),
            Datatype::Bytes => Data::Bytes(self.strings.into_iter().map(Into::into).collect()),
        })
    }
}

impl<'de> Deserialize<'de> for Values {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut values = Self::default();
        Level { values: &mut values, depth: 0 }.deserialize(deserializer)?;
        Ok(values)
    }
}

/// Reads an array, or below the outermost array a value.
struct Level<'a> {
    values: &'a mut Values,
    depth: usize,
}

impl Level<'_> {
    fn leaf<E: Error>(&mut self) -> Result<(), E> {
        if self.depth == 0 {
            return Err(E::custom("a value, expected an array"));
        }
        self.values.ragged |= *self.values.depth.get_or_insert(self.depth) != self.depth;
        Ok(())
    }

    fn number<E: Error>(mut self, number: Number) -> Result<(), E> {
        self.leaf()?;
        self.values.numbers.push(number);
        Ok(())
    }
}

impl<'de> DeserializeSeed<'de> for Level<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Level<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an array of numbers or of strings")
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<(), E> {
        self.number(Number::Whole(value))
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<(), E> {
        self.number(i64::try_from(value).map_or(Number::Real(value as f64), Number::Whole))
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<(), E> {
        self.number(Number::Real(value))
    }

    fn visit_str<E: Error>(mut self, value: &str) -> Result<(), E> {
        self.leaf()?;
        self.values.strings.push(value.to_owned());
        Ok(())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<(), A::Error> {
        let Self { values, depth } = self;
        if values.sizes.len() == depth {
            values.sizes.push(None);
        }
        let mut size = 0;
        while seq.next_element_seed(Level { values: &mut *values, depth: depth + 1 })?.is_some() {
            size += 1;
        }
        values.ragged |= *values.sizes[depth].get_or_insert(size) != size;
        // All values are in the innermost arrays.
        values.ragged |= values.depth.is_some_and(|at| at != values.sizes.len());
        Ok(())
    }
}
