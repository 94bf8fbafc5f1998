//! JSON schemas of what no derive can say: a word, or `{"given": [[x, y], ...]}`.

use std::borrow::Cow;

use utoipa::openapi::RefOr;
use utoipa::openapi::schema::{AdditionalProperties, ArrayBuilder, ObjectBuilder, OneOfBuilder, Schema, Type};
use utoipa::{PartialSchema, ToSchema};

use super::config::{Layout, Start};

/// A user's weight.
pub(super) enum Weight {}

impl PartialSchema for Weight {
    fn schema() -> RefOr<Schema> {
        ObjectBuilder::new().schema_type(Type::Number).minimum(Some(0)).maximum(Some(1e6)).into()
    }
}

impl ToSchema for Weight {}

impl PartialSchema for Start {
    fn schema() -> RefOr<Schema> {
        words_or_given(&["center", "random"])
    }
}

impl ToSchema for Start {
    fn name() -> Cow<'static, str> {
        "Start".into()
    }
}

impl PartialSchema for Layout {
    fn schema() -> RefOr<Schema> {
        words_or_given(&["random"])
    }
}

impl ToSchema for Layout {
    fn name() -> Cow<'static, str> {
        "Layout".into()
    }
}

fn words_or_given(words: &[&str]) -> RefOr<Schema> {
    let coordinate = ObjectBuilder::new().schema_type(Type::Number).minimum(Some(0)).maximum(Some(1));
    let point = ArrayBuilder::new().items(coordinate).min_items(Some(2)).max_items(Some(2));
    let given = ObjectBuilder::new()
        .property("given", ArrayBuilder::new().items(point))
        .required("given")
        .additional_properties(Some(AdditionalProperties::FreeForm(false)));
    let word = ObjectBuilder::new().schema_type(Type::String).enum_values(Some(words.iter().copied()));
    OneOfBuilder::new().item(word).item(given).into()
}
