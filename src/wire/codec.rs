//! The codec of all gRPC services: that of tonic, but a request that would take far more memory than its size is refused before it is
//! decoded.

use std::marker::PhantomData;
use std::sync::LazyLock;

use bytes::Buf;
use prost::{Message, Name};
use tonic::Status;
use tonic::codec::{BufferSettings, Codec, DecodeBuf, Decoder};
use tonic_prost::{ProstCodec, ProstEncoder};

use super::sizes::{Refusal, Sizes};

/// Messages up to this size are decoded without a check, so that small calls pay nothing for it: an empty element takes 2 bytes in a
/// message and at most some 600 in memory, so they stay near [`SPARE`].
const UNCHECKED: usize = 64 << 10;
/// Memory that any message may take.
const SPARE: usize = 32 << 20;
/// Memory that a message may take beyond [`SPARE`], per byte. Dense observations take about 3, sparse ones of nodes without ids up
/// to 7, integers of one byte each 8.
const PER_BYTE: usize = 8;

/// Encodes `T` and decodes `U`.
pub struct BoundedCodec<T, U>(PhantomData<(T, U)>);

impl<T, U> Default for BoundedCodec<T, U> {
    fn default() -> Self {
        Self(PhantomData)
    }
}

impl<T, U> Codec for BoundedCodec<T, U>
where
    T: Message + Send + 'static,
    U: Message + Name + Default + Send + 'static,
{
    type Encode = T;
    type Decode = U;
    type Encoder = ProstEncoder<T>;
    type Decoder = BoundedDecoder<U>;

    fn encoder(&mut self) -> ProstEncoder<T> {
        ProstCodec::<T, U>::raw_encoder(BufferSettings::default())
    }

    fn decoder(&mut self) -> BoundedDecoder<U> {
        BoundedDecoder(PhantomData)
    }
}

/// Decodes messages of the type `U`.
pub struct BoundedDecoder<U>(PhantomData<U>);

impl<U: Message + Name + Default> Decoder for BoundedDecoder<U> {
    type Item = U;
    type Error = Status;

    fn decode(&mut self, buf: &mut DecodeBuf<'_>) -> Result<Option<U>, Status> {
        if buf.remaining() > UNCHECKED {
            check(&U::full_name(), buf)?;
        }
        Ok(Some(U::decode(buf).map_err(|error| Status::internal(error.to_string()))?))
    }
}

/// Refuses a request whose decoded form would take too much memory. Responses to clients are not checked.
fn check(name: &str, buf: &mut DecodeBuf<'_>) -> Result<(), Status> {
    static SIZES: LazyLock<Sizes> = LazyLock::new(|| Sizes::new(super::DESCRIPTORS));
    let size = buf.remaining();
    let whole = buf.chunk();
    // tonic hands a message over in one piece; without that it could not be read twice.
    if whole.len() < size {
        return Err(Status::internal("a message in pieces"));
    }
    let limit = SPARE.saturating_add(PER_BYTE.saturating_mul(size));
    match SIZES.check(name, whole, limit) {
        Ok(()) => Ok(()),
        Err(Refusal::Malformed(reason)) => Err(Status::internal(format!("failed to decode Protobuf message: {reason}"))),
        // The code with which tonic refuses messages that are too large.
        Err(Refusal::Large(field)) => Err(Status::out_of_range(format!(
            "{field}: too many elements: the message has {size} bytes and would take more than {limit} bytes of memory"
        ))),
    }
}
