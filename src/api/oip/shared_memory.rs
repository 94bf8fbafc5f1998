//! Shared memory: there are no regions, and none can be registered.

use crate::invalid::Invalid;
use crate::service::Error;

/// Checks a request for the status of region `name`, or of all regions if it is empty.
///
/// # Errors
/// [`Error::NotFound`] for any name.
pub fn status(name: &str) -> Result<(), Error> {
    if name.is_empty() { Ok(()) } else { Err(Error::not_found("region of shared memory", name)) }
}

/// Refuses to register a region.
///
/// # Errors
/// Always [`Error::Invalid`].
pub fn register(name: &str) -> Result<(), Error> {
    let expected = "no region: shared memory is not supported, send the tensors with the request";
    Err(Invalid::new("name", format!("{name:?}"), expected).into())
}
