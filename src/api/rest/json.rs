//! Reads JSON by the rules of JSON Schema. Derived `Deserialize` differs in two points: it accepts an array for an object, and
//! rejects `3.0` for an integer.

use std::fmt;
use std::marker::PhantomData;

use serde::de::{Deserializer, Error, Unexpected, Visitor};
use serde::{Deserialize, forward_to_deserialize_any};

/// A deserializer that reads structs from objects only, not from arrays of their fields.
pub(super) struct ObjectOnly<D>(pub(super) D);

impl<'de, D: Deserializer<'de>> Deserializer<'de> for ObjectOnly<D> {
    type Error = D::Error;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, D::Error> {
        self.0.deserialize_any(visitor)
    }

    fn deserialize_struct<V>(self, _: &'static str, _: &'static [&'static str], visitor: V) -> Result<V::Value, D::Error>
    where
        V: Visitor<'de>,
    {
        self.0.deserialize_map(visitor)
    }

    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf option unit unit_struct
        newtype_struct seq tuple tuple_struct map enum identifier ignored_any
    }
}

/// Implements `Deserialize` from objects only, at any depth of a document, for types that derive it with
/// `#[serde(remote = "Self")]`. Write `Serialize +` for types that also derive `Serialize`.
macro_rules! objects_only {
    (Serialize + $($type:ty),+) => {
        crate::api::rest::json::objects_only!($($type),+);
        $(impl serde::Serialize for $type {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                <$type>::serialize(self, serializer)
            }
        })+
    };
    ($($type:ty),+) => {
        $(impl<'de> serde::Deserialize<'de> for $type {
            fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                <$type>::deserialize(crate::api::rest::json::ObjectOnly(deserializer))
            }
        })+
    };
}
pub(super) use objects_only;

/// An integer of type `T` in any notation: `3`, `3.0`, `3e0`.
struct Integer<T>(T);

impl<'de, T: TryFrom<i128>> Deserialize<'de> for Integer<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct IntegerVisitor<T>(PhantomData<T>);

        impl<T: TryFrom<i128>> Visitor<'_> for IntegerVisitor<T> {
            type Value = Integer<T>;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(std::any::type_name::<T>())
            }

            fn visit_i64<E: Error>(self, value: i64) -> Result<Integer<T>, E> {
                T::try_from(value.into()).map(Integer).map_err(|_| E::invalid_value(Unexpected::Signed(value), &self))
            }

            fn visit_u64<E: Error>(self, value: u64) -> Result<Integer<T>, E> {
                T::try_from(value.into()).map(Integer).map_err(|_| E::invalid_value(Unexpected::Unsigned(value), &self))
            }

            fn visit_f64<E: Error>(self, value: f64) -> Result<Integer<T>, E> {
                // The conversion saturates at bounds that no `T` contains.
                let whole = Some(value as i128).filter(|_| value.fract() == 0.0);
                let integer = whole.and_then(|whole| T::try_from(whole).ok());
                integer.map(Integer).ok_or_else(|| E::invalid_value(Unexpected::Float(value), &self))
            }
        }

        deserializer.deserialize_any(IntegerVisitor(PhantomData))
    }
}

/// For `deserialize_with`: an integer.
pub(super) fn integer<'de, D: Deserializer<'de>, T: TryFrom<i128>>(deserializer: D) -> Result<T, D::Error> {
    Integer::deserialize(deserializer).map(|Integer(value)| value)
}

/// For `deserialize_with`: an integer or null.
pub(super) fn optional_integer<'de, D: Deserializer<'de>, T: TryFrom<i128>>(deserializer: D) -> Result<Option<T>, D::Error> {
    Option::deserialize(deserializer).map(|value| value.map(|Integer(value)| value))
}

/// For `deserialize_with`: a list of integers.
pub(super) fn integers<'de, D: Deserializer<'de>, T: TryFrom<i128>>(deserializer: D) -> Result<Vec<T>, D::Error> {
    Vec::deserialize(deserializer).map(|values| values.into_iter().map(|Integer(value)| value).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Deserialize, PartialEq)]
    #[serde(deny_unknown_fields)]
    struct Outer {
        #[serde(default, deserialize_with = "optional_integer")]
        count: Option<u32>,
        #[serde(default)]
        inner: Vec<Inner>,
    }

    #[derive(Debug, Deserialize, PartialEq)]
    #[serde(remote = "Self")]
    struct Inner {
        x: f64,
        #[serde(deserialize_with = "integer")]
        step: u64,
    }

    objects_only!(Inner);

    fn read(text: &str) -> Result<Outer, String> {
        Outer::deserialize(ObjectOnly(&mut serde_json::Deserializer::from_str(text))).map_err(|e| e.to_string())
    }

    #[test]
    fn integers_are_accepted_in_every_notation() {
        let outer = read(r#"{"count": 3.0, "inner": [{"x": 1, "step": 2e1}, {"x": 1, "step": 18446744073709551615}]}"#).unwrap();
        assert_eq!(outer.count, Some(3));
        assert_eq!(outer.inner, [Inner { x: 1.0, step: 20 }, Inner { x: 1.0, step: u64::MAX }]);
        assert_eq!(read(r#"{"count": null}"#).unwrap().count, None);
        for wrong in ["3.5", "-1", "-1.0", "4294967296", "4294967296.0", "1e300", "\"3\"", "[3]"] {
            assert!(read(&format!(r#"{{"count": {wrong}}}"#)).unwrap_err().contains("expected u32"), "{wrong}");
        }
    }

    #[test]
    fn lists_are_not_objects_and_fields_occur_once() {
        assert!(read("[3, []]").unwrap_err().contains("invalid type: sequence, expected struct Outer"));
        assert!(read(r#"{"inner": [[1, 2]]}"#).unwrap_err().contains("invalid type: sequence, expected struct Inner"));
        assert!(read(r#"{"count": 3, "count": 3}"#).unwrap_err().contains("duplicate field `count`"));
    }
}
