//! Schemas of texts that have a form of their own; the types are never made.

use std::borrow::Cow;

use utoipa::openapi::RefOr;
use utoipa::openapi::schema::{KnownFormat, ObjectBuilder, Schema, SchemaFormat, Type};
use utoipa::{PartialSchema, ToSchema};

/// A policy's name, or an alias's.
macro_rules! name {
    () => {
        "[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}"
    };
}

/// A version's number.
macro_rules! version {
    () => {
        "[1-9][0-9]{0,18}"
    };
}

macro_rules! texts {
    ($($(#[$doc:meta])* $name:ident = $pattern:expr;)+) => {$(
        $(#[$doc])*
        pub(super) enum $name {}

        impl PartialSchema for $name {
            fn schema() -> RefOr<Schema> {
                ObjectBuilder::new().schema_type(Type::String).pattern(Some($pattern)).into()
            }
        }

        impl ToSchema for $name {
            fn name() -> Cow<'static, str> {
                stringify!($name).into()
            }
        }
    )+};
}

/// Bytes as they come.
pub(super) enum Bytes {}

impl PartialSchema for Bytes {
    fn schema() -> RefOr<Schema> {
        ObjectBuilder::new().schema_type(Type::String).format(Some(SchemaFormat::KnownFormat(KnownFormat::Binary))).into()
    }
}

impl ToSchema for Bytes {}

/// A heading's index.
pub(super) enum Heading {}

impl PartialSchema for Heading {
    fn schema() -> RefOr<Schema> {
        ObjectBuilder::new().schema_type(Type::Integer).minimum(Some(0)).maximum(Some(8)).into()
    }
}

impl ToSchema for Heading {}

texts! {
    /// NAME of a policy or an alias.
    Name = concat!("^", name!(), "$");
    /// NAME or NAME:VERSION.
    Versions = concat!("^", name!(), "(:", version!(), ")?$");
    /// NAME, NAME@ALIAS or NAME:VERSION.
    PolicySpec = concat!("^", name!(), "(@", name!(), "|:", version!(), ")?$");
    /// The same, or nothing.
    OptionalPolicySpec = concat!("^(", name!(), "(@", name!(), "|:", version!(), ")?)?$");
    /// Where the next page begins: digits, or nothing for the first.
    NumberToken = "^[0-9]{0,18}$";
    /// The metric after which a page begins; empty for the first page.
    MetricToken = "^([A-Za-z0-9_/.-]{1,63}@[0-9]{1,18})?$";
    /// Seconds with an `s`: `0.000021000s`.
    Seconds = "^[0-9]+\\.[0-9]{9}s$";
    /// SHA-256 in hexadecimal.
    Sha256 = "^[0-9a-f]{64}$";
    /// Bytes in base64.
    Base64Text = "^([A-Za-z0-9+/]{4})*([A-Za-z0-9+/][AQgw]==|[A-Za-z0-9+/]{2}[AEIMQUYcgkosw048]=)?$";
    /// The kind of a node, in the words of the protocol or without its prefix.
    NodeKind = "^(NODE_KIND_UAV|NODE_KIND_USER|uav|user)$";
}
