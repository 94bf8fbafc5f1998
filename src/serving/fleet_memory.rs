//! The memory of a fleet between two slots. A policy works on a vector of f32 of fixed length; what is kept between slots, in a
//! session or by the caller, takes as little room as its content.
//!
//! Small memories stay vectors, so that small fleets are computed without allocations. Large ones are packed; the engine unpacks
//! one when it computes the slot, so that waiting requests hold packed memories only.
//!
//! Packed form: groups of four numbers. The first byte of a group holds two bits per number, the lowest bits for the first
//! number: 0 is the number 0; 1 is an integer from -128 to 127, as one byte; 2 is the last number in the same column that was not 0;
//! 3 is any f32, as four bytes (little endian). These bytes follow. A group of four zeros is followed by one byte: how many more such
//! groups follow. Columns repeat with the period that the policy gives, such as the numbers of one UAV, so what several UAVs know is stored once.
//! The number of numbers is not stored: whoever unpacks knows it, so no bytes can demand more memory than the fleet needs.

use bytes::Bytes;

use crate::invalid::Invalid;
use crate::policy::Policy;

/// Memories of at most this many numbers are not packed.
pub(super) const MAX_PLAIN_LEN: usize = 4096;

/// The memory of a fleet of M UAVs and N users, which the methods get as `(uavs, users)`.
#[derive(Clone, Debug, PartialEq)]
pub enum FleetMemory {
    /// As the policy uses it.
    Plain(Vec<f32>),
    /// Packed.
    Packed(Bytes),
    /// The large memory of slot 0, as its seed.
    Initial(u64),
}

impl Default for FleetMemory {
    fn default() -> Self {
        Self::Plain(Vec::new())
    }
}

impl FleetMemory {
    /// The memory of slot 0. `buffer` may be used.
    pub fn initial(policy: &dyn Policy, (uavs, users): (usize, usize), seed: u64, mut buffer: Vec<f32>) -> Self {
        let len = policy.memory_len(uavs, users);
        if len > MAX_PLAIN_LEN {
            return Self::Initial(seed);
        }
        buffer.clear();
        buffer.resize(len, 0.0);
        policy.start(uavs, users, seed, &mut buffer);
        Self::Plain(buffer)
    }

    /// A copy of the memory. `buffer` may be used.
    pub(super) fn copy(&self, mut buffer: Vec<f32>) -> Self {
        let Self::Plain(numbers) = self else { return self.clone() };
        buffer.clear();
        buffer.extend_from_slice(numbers);
        Self::Plain(buffer)
    }

    /// The vector that [`FleetMemory::copy`] can use as a buffer, if this memory has one.
    pub(super) fn into_buffer(self) -> Vec<f32> {
        if let Self::Plain(numbers) = self { numbers } else { Vec::new() }
    }

    /// Whether the memory is in the form that the policy uses.
    pub(super) fn is_plain(&self) -> bool {
        matches!(self, Self::Plain(_))
    }

    /// Bytes that the memory takes.
    pub(super) fn bytes(&self) -> usize {
        match self {
            Self::Plain(numbers) => numbers.capacity() * size_of::<f32>(),
            Self::Packed(bytes) => bytes.len(),
            Self::Initial(_) => 0,
        }
    }

    /// The packed form, for the caller to keep.
    pub fn into_packed(self, policy: &dyn Policy, (uavs, users): (usize, usize)) -> Bytes {
        match self {
            Self::Plain(numbers) => pack(&numbers, policy.memory_period(uavs, users)).into(),
            Self::Packed(bytes) => bytes,
            // Only memory that a policy has used is handed out.
            Self::Initial(_) => Bytes::new(),
        }
    }

    /// The numbers that the policy works on.
    ///
    /// # Errors
    /// Names `recurrent_state` if the memory is not one of this policy and fleet.
    pub fn unpack(self, policy: &dyn Policy, (uavs, users): (usize, usize)) -> Result<Vec<f32>, Invalid> {
        let len = policy.memory_len(uavs, users);
        let numbers = match self {
            Self::Plain(numbers) => (numbers.len() == len).then_some(numbers),
            Self::Packed(bytes) => unpack(&bytes, len, policy.memory_period(uavs, users)),
            Self::Initial(seed) => {
                let mut numbers = vec![0.0; len];
                policy.start(uavs, users, seed, &mut numbers);
                Some(numbers)
            }
        };
        numbers.ok_or_else(|| {
            let expected = "the recurrent_state of an earlier response to the same UAVs and users";
            Invalid::new("recurrent_state", "a state of another form", expected)
        })
    }

    /// The same memory, unpacked if it is small. The engine unpacks large ones.
    ///
    /// # Errors
    /// As [`FleetMemory::unpack`], for small memory.
    pub fn unpack_small(self, policy: &dyn Policy, (uavs, users): (usize, usize)) -> Result<Self, Invalid> {
        if policy.memory_len(uavs, users) > MAX_PLAIN_LEN {
            return Ok(self);
        }
        self.unpack(policy, (uavs, users)).map(Self::Plain)
    }

    /// The memory in `numbers`, packed if it is large.
    pub(super) fn pack(numbers: Vec<f32>, policy: &dyn Policy, (uavs, users): (usize, usize)) -> Self {
        if numbers.len() <= MAX_PLAIN_LEN {
            return Self::Plain(numbers);
        }
        Self::Packed(pack(&numbers, policy.memory_period(uavs, users)).into())
    }
}

/// Numbers of a group.
const GROUP: usize = 4;
/// Kinds of numbers.
const ZERO: u8 = 0;
const INTEGER: u8 = 1;
const REPEATED: u8 = 2;
const ANY: u8 = 3;

/// The last number of each column that was not 0.
struct Columns {
    last: Vec<f32>,
    column: usize,
}

impl Columns {
    /// As many columns as the numbers have a period.
    fn new(period: usize) -> Self {
        Self { last: vec![0.0; period.max(1)], column: 0 }
    }

    fn skip(&mut self, numbers: usize) {
        self.column = (self.column + numbers) % self.last.len();
    }

    /// The last number of the current column; moves to the next column.
    fn next(&mut self) -> &mut f32 {
        let column = self.column;
        self.column = if column + 1 == self.last.len() { 0 } else { column + 1 };
        &mut self.last[column]
    }
}

fn pack(numbers: &[f32], period: usize) -> Vec<u8> {
    let mut columns = Columns::new(period);
    let mut bytes = Vec::new();
    let mut groups = numbers.chunks(GROUP).peekable();
    let is_zero = |group: &[f32]| group.iter().all(|x| x.to_bits() == 0);
    while let Some(group) = groups.next() {
        if is_zero(group) {
            let mut more = 0;
            while more < u8::MAX && groups.next_if(|group| is_zero(group)).is_some() {
                more += 1;
            }
            bytes.extend([0, more]);
            columns.skip(GROUP * (1 + usize::from(more)));
            continue;
        }
        let head = bytes.len();
        bytes.push(0);
        for (i, &x) in group.iter().enumerate() {
            let last = columns.next();
            let kind = if x.to_bits() == 0 {
                ZERO
            } else if x.to_bits() == last.to_bits() {
                REPEATED
            } else if f32::from(x as i8).to_bits() == x.to_bits() {
                bytes.push(x as i8 as u8);
                INTEGER
            } else {
                bytes.extend(x.to_le_bytes());
                ANY
            };
            if kind != ZERO {
                *last = x;
            }
            bytes[head] |= kind << (2 * i);
        }
    }
    bytes
}

/// The `len` numbers in `bytes`, or `None` if it is not the packed form of as many numbers.
fn unpack(mut bytes: &[u8], len: usize, period: usize) -> Option<Vec<f32>> {
    // Every two bytes are at least one and at most 256 groups.
    if bytes.len() > len.div_ceil(GROUP) * (1 + GROUP * size_of::<f32>()) || bytes.len() * 512 < len {
        return None;
    }
    let mut columns = Columns::new(period);
    let mut numbers = Vec::with_capacity(len);
    while numbers.len() < len {
        let (&kinds, rest) = bytes.split_first()?;
        bytes = rest;
        if kinds == 0 {
            let (&more, rest) = bytes.split_first()?;
            bytes = rest;
            let zeros = GROUP * (1 + usize::from(more));
            columns.skip(zeros);
            numbers.resize((numbers.len() + zeros).min(len), 0.0);
            continue;
        }
        for i in 0..GROUP.min(len - numbers.len()) {
            let last = columns.next();
            let x = match kinds >> (2 * i) & 3 {
                ZERO => 0.0,
                INTEGER => {
                    let (&byte, rest) = bytes.split_first()?;
                    bytes = rest;
                    f32::from(byte as i8)
                }
                REPEATED => *last,
                _ => {
                    let (&any, rest) = bytes.split_first_chunk()?;
                    bytes = rest;
                    f32::from_le_bytes(any)
                }
            };
            if x.to_bits() != 0 {
                *last = x;
            }
            numbers.push(x);
        }
    }
    bytes.is_empty().then_some(numbers)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn bits(numbers: &[f32]) -> Vec<u32> {
        numbers.iter().map(|x| x.to_bits()).collect()
    }

    #[test]
    fn what_all_uavs_know_is_stored_once() {
        // 100 UAVs that know 10 of 1000 users, each user with five numbers.
        let user = |j: usize| if j.is_multiple_of(100) { [1.0, j as f32 / 3.0, 0.7, 12.0, 14.0] } else { [0.0; 5] };
        let row: Vec<f32> = (0..1000).flat_map(user).collect();
        let numbers = row.repeat(100);
        let bytes = pack(&numbers, 5000);
        assert!(bytes.len() < 100 * 10 * 8, "{} bytes for {} numbers", bytes.len(), numbers.len());
        assert_eq!(unpack(&bytes, numbers.len(), 5000), Some(numbers));
        assert_eq!(pack(&vec![0.0; 10_240], 3).len(), 20);
    }

    #[test]
    fn bytes_cannot_demand_more_numbers_than_the_fleet_has() {
        let bytes = pack(&[1.5; 100], 1);
        assert!(unpack(&bytes, 100, 1).is_some());
        for len in [0, 1, 96, 101, 104, 1 << 40] {
            assert_eq!(unpack(&bytes, len, 1), None, "{len}");
        }
    }

    fn number() -> impl Strategy<Value = f32> {
        prop_oneof![4 => Just(0.0), 2 => (-130..130_i32).prop_map(|x| x as f32), 2 => any::<f32>(), 1 => Just(-0.0), 1 => Just(0.25)]
    }

    proptest! {
        #[test]
        fn unpacked_numbers_have_the_same_bits(numbers in prop::collection::vec(number(), 0..300), uavs in 0..7_usize) {
            let bytes = pack(&numbers, uavs);
            prop_assert_eq!(unpack(&bytes, numbers.len(), uavs).map(|back| bits(&back)), Some(bits(&numbers)));
            prop_assert!(bytes.len() <= numbers.len().div_ceil(4) * 17);
            for len in 0..bytes.len() {
                prop_assert!(unpack(&bytes[..len], numbers.len(), uavs).is_none(), "{} of {} bytes", len, bytes.len());
            }
        }

        #[test]
        fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200), len in 0..2000_usize, uavs in 0..9_usize) {
            if let Some(numbers) = unpack(&bytes, len, uavs) {
                prop_assert_eq!(numbers.len(), len);
            }
        }
    }
}
