//! Compressed bodies and messages of the Open Inference Protocol: gzip and deflate (the zlib format), as its clients send them.
//!
//! A small body can inflate to a thousand times its size. It is therefore inflated in steps, each of which counts against the limit of
//! a message and against the budget of bytes in flight.

use std::io::{self, Read, Write};

use axum::http::HeaderMap;
use bytes::buf::Reader;
use bytes::{Buf, Bytes, BytesMut};
use flate2::Compression;
use flate2::bufread::{GzDecoder, ZlibDecoder};
use flate2::write::{GzEncoder, ZlibEncoder};

use crate::invalid::Invalid;
use crate::service::Error;

/// Bytes that one step inflates: it takes well below a millisecond.
pub const STEP: usize = 64 << 10;

/// A compression.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// gzip.
    Gzip,
    /// The zlib format, which HTTP and gRPC call deflate.
    Deflate,
}

impl Encoding {
    /// The encoding with this name.
    pub fn parse(name: &str) -> Option<Self> {
        [Self::Gzip, Self::Deflate].into_iter().find(|encoding| encoding.name().eq_ignore_ascii_case(name))
    }

    /// Its name in headers.
    pub fn name(self) -> &'static str {
        match self {
            Self::Gzip => "gzip",
            Self::Deflate => "deflate",
        }
    }

    /// The encoding that a header such as `accept-encoding` prefers, gzip before deflate; none if it accepts neither.
    pub fn accepted(headers: &HeaderMap, header: &str) -> Option<Self> {
        let accepts = |encoding: Self| {
            let values = headers.get_all(header).iter().filter_map(|value| value.to_str().ok());
            values.flat_map(|value| value.split(',')).any(|item| {
                let (name, weight) = item.split_once(';').unwrap_or((item, ""));
                let weight: Option<f32> = weight.trim().strip_prefix("q=").and_then(|q| q.trim().parse().ok());
                name.trim().eq_ignore_ascii_case(encoding.name()) && weight != Some(0.0)
            })
        };
        [Self::Gzip, Self::Deflate].into_iter().find(|&encoding| accepts(encoding))
    }

    /// Compresses `data`, fast rather than small.
    ///
    /// # Errors
    /// None occur, because the result is in memory.
    pub fn compress(self, data: &[u8]) -> io::Result<Vec<u8>> {
        let out = Vec::with_capacity(data.len() / 2);
        match self {
            Self::Gzip => {
                let mut encoder = GzEncoder::new(out, Compression::fast());
                encoder.write_all(data)?;
                encoder.finish()
            }
            Self::Deflate => {
                let mut encoder = ZlibEncoder::new(out, Compression::fast());
                encoder.write_all(data)?;
                encoder.finish()
            }
        }
    }
}

enum Decoder {
    Gzip(GzDecoder<Reader<Bytes>>),
    Deflate(ZlibDecoder<Reader<Bytes>>),
}

/// Inflates one body or message.
pub struct Inflater {
    decoder: Decoder,
    encoding: Encoding,
    out: BytesMut,
    limit: usize,
}

impl Inflater {
    /// Inflates `data` to at most `limit` bytes, after the bytes `head`.
    pub fn new(encoding: Encoding, data: Bytes, head: &[u8], limit: usize) -> Self {
        let data = data.reader();
        let decoder = match encoding {
            Encoding::Gzip => Decoder::Gzip(GzDecoder::new(data)),
            Encoding::Deflate => Decoder::Deflate(ZlibDecoder::new(data)),
        };
        Self { decoder, encoding, out: BytesMut::from(head), limit: limit + head.len() }
    }

    /// Inflates at most [`STEP`] bytes and returns their number; 0 at the end.
    ///
    /// # Errors
    /// [`Error::TooLarge`] beyond the limit, [`Error::Invalid`] for data that is not of the encoding.
    pub fn step(&mut self) -> Result<usize, Error> {
        let before = self.out.len();
        self.out.resize(before + STEP, 0);
        let space = &mut self.out[before..];
        let read = match &mut self.decoder {
            Decoder::Gzip(decoder) => decoder.read(space),
            Decoder::Deflate(decoder) => decoder.read(space),
        };
        let read = read.map_err(|error| self.invalid(&error))?;
        self.out.truncate(before + read);
        if self.out.len() > self.limit {
            let message = format!("the body inflates to more than the limit of {} bytes", self.limit);
            return Err(Error::TooLarge { message, limit: Some(self.limit as u64) });
        }
        let rest = match &self.decoder {
            Decoder::Gzip(decoder) => decoder.get_ref().get_ref().remaining(),
            Decoder::Deflate(decoder) => decoder.get_ref().get_ref().remaining(),
        };
        if read == 0 && rest > 0 { Err(self.invalid(&format!("{rest} bytes after its end"))) } else { Ok(read) }
    }

    fn invalid(&self, reason: &dyn std::fmt::Display) -> Error {
        let name = self.encoding.name();
        Invalid::new("body", reason, format!("data in the format {name}, because the encoding says {name}")).into()
    }

    /// What was inflated, with the head.
    pub fn finish(self) -> BytesMut {
        self.out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::header::ACCEPT_ENCODING;

    fn inflate(encoding: Encoding, data: &[u8], limit: usize) -> Result<Vec<u8>, Error> {
        let mut inflater = Inflater::new(encoding, Bytes::copy_from_slice(data), b"head", limit);
        while inflater.step()? > 0 {}
        Ok(inflater.finish().to_vec())
    }

    #[test]
    fn what_was_compressed_is_inflated_up_to_the_limit() {
        let data: Vec<u8> = (0..300_000_u32).map(|i| (i / 7) as u8).collect();
        for encoding in [Encoding::Gzip, Encoding::Deflate] {
            let small = encoding.compress(&data).unwrap();
            assert!(small.len() < data.len() / 10);
            assert_eq!(inflate(encoding, &small, data.len()).unwrap(), [b"head", &data[..]].concat());
            let refused = inflate(encoding, &small, data.len() - 1).unwrap_err();
            assert!(matches!(refused, Error::TooLarge { .. }), "{refused:?}");
            for wrong in [&small[..small.len() / 2], b"not compressed at all", b"", &[&small[..], b"more"].concat()] {
                assert!(matches!(inflate(encoding, wrong, data.len()), Err(Error::Invalid(_))));
            }
        }
    }

    #[test]
    fn the_preferred_encoding_is_found_in_headers() {
        let of = |value: &str| {
            let headers = [(ACCEPT_ENCODING, value.parse().unwrap())].into_iter().collect();
            Encoding::accepted(&headers, "accept-encoding")
        };
        assert_eq!(of("deflate, gzip;q=0.5, br"), Some(Encoding::Gzip));
        assert_eq!(of("gzip;q=0, deflate"), Some(Encoding::Deflate));
        for neither in ["identity", "br", "gzip; q=0", "", "*"] {
            assert_eq!(of(neither), None, "{neither}");
        }
    }
}
