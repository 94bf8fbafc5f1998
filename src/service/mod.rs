//! Use cases: one function each, one error type. Both transports call only this.

mod error;

pub use error::Error;

use crate::store::Store;

/// What use cases work with; shared by all connections behind an `Arc`.
pub struct App {
    /// Durable state.
    pub store: Store,
}
