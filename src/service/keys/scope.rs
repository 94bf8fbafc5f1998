//! What a key opens.

use std::fmt;
use std::str::FromStr;

use serde::{Serialize, Serializer};

use crate::invalid::Invalid;

/// A part of what the server does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scope {
    /// Lists, shows, metrics, reflection.
    Read,
    /// Acts, sessions, environments, inference.
    Act,
    /// Submitting, cancelling, pausing, resuming, deleting jobs.
    Jobs,
    /// Policies and aliases; and all of the above.
    Admin,
}

impl Scope {
    /// All, in the order in which they are written.
    pub const ALL: [Self; 4] = [Self::Read, Self::Act, Self::Jobs, Self::Admin];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Read => "read",
            Self::Act => "act",
            Self::Jobs => "jobs",
            Self::Admin => "admin",
        }
    }
}

/// Scopes of one key, at least one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Scopes(u8);

impl Scopes {
    fn bit(scope: Scope) -> u8 {
        1 << scope as u8
    }

    /// Whether what needs `scope` is open: `admin` opens everything.
    pub fn open(self, scope: Scope) -> bool {
        self.0 & (Self::bit(scope) | Self::bit(Scope::Admin)) != 0
    }

    /// The scopes, without those that others imply.
    pub fn iter(self) -> impl Iterator<Item = Scope> {
        Scope::ALL.into_iter().filter(move |scope| self.0 & Self::bit(*scope) != 0)
    }

    /// As stored. A name that this version does not know opens nothing.
    pub(super) fn stored(text: &str) -> Self {
        let known = text.split(',').filter_map(|name| Scope::ALL.into_iter().find(|scope| scope.name() == name));
        Self(known.fold(0, |bits, scope| bits | Self::bit(scope)))
    }
}

impl FromStr for Scopes {
    type Err = Invalid;

    fn from_str(text: &str) -> Result<Self, Invalid> {
        let mut bits = 0;
        for name in text.split(',').map(str::trim) {
            let found = Scope::ALL.into_iter().find(|scope| scope.name() == name);
            let scope = found.ok_or_else(|| {
                Invalid::new("scopes", format!("{name:?}"), "one or more of read, act, jobs and admin, separated by commas")
            })?;
            bits |= Self::bit(scope);
        }
        Ok(Self(bits))
    }
}

impl fmt::Display for Scopes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.iter().enumerate().try_for_each(|(i, scope)| write!(f, "{}{}", if i == 0 { "" } else { "," }, scope.name()))
    }
}

impl Serialize for Scopes {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self.iter().map(Scope::name))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scopes_read_as_written_and_admin_opens_all() {
        let scopes: Scopes = "act, read".parse().unwrap();
        assert_eq!(scopes.to_string(), "read,act");
        assert_eq!(scopes, "read,act".parse().unwrap());
        assert_eq!(Scopes::stored(&scopes.to_string()), scopes);
        let open = |scopes: Scopes| Scope::ALL.map(|scope| scopes.open(scope));
        assert_eq!(open(scopes), [true, true, false, false]);
        assert_eq!(open("admin".parse().unwrap()), [true; 4]);
        assert_eq!(open(Scopes::stored("of a later version,jobs")), [false, false, true, false]);
        for wrong in ["", "read,", "READ", "read;act", "all"] {
            let error = wrong.parse::<Scopes>().unwrap_err();
            assert_eq!(error.field, "scopes", "{wrong}");
        }
    }
}
