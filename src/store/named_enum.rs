//! Enums whose values are stored and sent by name.

/// Defines an enum whose values are stored and sent by name.
macro_rules! named_enum {
    ($(#[$doc:meta])* $type:ident { $($(#[$variant_doc:meta])* $variant:ident = $name:tt,)+ }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
        pub enum $type {
            $($(#[$variant_doc])* #[serde(rename = $name)] $variant,)+
        }

        impl $type {
            /// All names.
            pub const NAMES: &[&str] = &[$($name),+];

            /// The name of this value.
            pub fn as_str(self) -> &'static str {
                match self { $(Self::$variant => $name,)+ }
            }

            /// The value called `name`.
            pub fn parse(name: &str) -> Option<Self> {
                match name { $($name => Some(Self::$variant),)+ _ => None }
            }

            /// Parses a name from the database.
            #[allow(dead_code, reason = "some types are only written")]
            pub(super) fn from_column(name: &str) -> crate::store::Result<Self> {
                Self::parse(name).ok_or_else(|| crate::store::corrupt(stringify!($type), name, "unknown"))
            }
        }

        impl std::fmt::Display for $type {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(self.as_str())
            }
        }
    };
}
pub(super) use named_enum;
