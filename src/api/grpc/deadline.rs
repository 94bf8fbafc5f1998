//! The deadline of a call, from the header `grpc-timeout`.

use std::time::{Duration, Instant};

use axum::http::Request;
use tonic::Extensions;

/// Time at which the client stops waiting.
#[derive(Clone, Copy, Debug)]
pub(super) struct Deadline(pub(super) Instant);

/// Puts the deadline of a request into its extensions. To be called when the head of the request arrives.
pub(super) fn read_deadline<B>(mut request: Request<B>) -> Request<B> {
    let timeout = request.headers().get("grpc-timeout").and_then(|value| timeout(value.to_str().ok()?));
    if let Some(timeout) = timeout {
        request.extensions_mut().insert(Deadline(Instant::now() + timeout));
    }
    request
}

/// The deadline of a request.
pub(super) fn deadline(extensions: &Extensions) -> Option<Instant> {
    extensions.get::<Deadline>().map(|deadline| deadline.0)
}

/// Parses a `grpc-timeout`: up to 8 digits and a unit.
fn timeout(value: &str) -> Option<Duration> {
    let (digits, unit) = value.split_at_checked(value.len().checked_sub(1)?)?;
    if digits.is_empty() || digits.len() > 8 || !digits.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    let n: u64 = digits.parse().ok()?;
    Some(match unit {
        "H" => Duration::from_secs(n * 3600),
        "M" => Duration::from_secs(n * 60),
        "S" => Duration::from_secs(n),
        "m" => Duration::from_millis(n),
        "u" => Duration::from_micros(n),
        "n" => Duration::from_nanos(n),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timeouts_are_parsed_as_the_grpc_specification_defines() {
        assert_eq!(timeout("100m"), Some(Duration::from_millis(100)));
        assert_eq!(timeout("99999999H"), Some(Duration::from_secs(99_999_999 * 3600)));
        assert_eq!(timeout("0n"), Some(Duration::ZERO));
        for wrong in ["", "m", "5", "123456789S", "-1S", "1x", "1é"] {
            assert_eq!(timeout(wrong), None, "{wrong}");
        }
    }
}
