//! Chooses the processor's vector units at run time.
//!
//! `QEDGIX_VECTOR_WIDTH` caps the width: `portable`, `neon`, `avx2` or `avx512`. The widest units up to it are used.

use std::sync::OnceLock;

use pulp::{Arch, WithSimd};

/// The environment variable that caps the width.
pub const VECTOR_WIDTH_VARIABLE: &str = "QEDGIX_VECTOR_WIDTH";

/// Vector units, by width.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum VectorWidth {
    /// What every processor of the architecture has. Multiplies and adds with two roundings, the others with one.
    Portable,
    /// 128 bits: NEON (aarch64).
    Neon,
    /// 256 bits: AVX2 and FMA (x86-64).
    Avx2,
    /// 512 bits: AVX-512 (x86-64).
    Avx512,
}

impl VectorWidth {
    /// All widths, the narrowest first.
    pub const ALL: [Self; 4] = [Self::Portable, Self::Neon, Self::Avx2, Self::Avx512];

    /// The widths of this processor, the narrowest first, whatever the cap.
    pub fn available() -> Vec<Self> {
        Self::ALL.into_iter().filter(|width| width.arch().is_some()).collect()
    }

    /// The width that the networks use: the widest one of this processor up to the cap.
    pub fn current() -> Self {
        let cap = Self::cap().ok().flatten().unwrap_or(Self::Avx512);
        Self::available().into_iter().rfind(|&width| width <= cap).unwrap_or(Self::Portable)
    }

    /// The cap of the environment, if there is one.
    ///
    /// # Errors
    /// The variable's value, if it is not the name of a width.
    pub fn cap() -> Result<Option<Self>, String> {
        let Some(value) = std::env::var_os(VECTOR_WIDTH_VARIABLE) else { return Ok(None) };
        let value = value.to_string_lossy();
        Self::ALL.into_iter().find(|width| width.name() == value).map(Some).ok_or_else(|| value.into_owned())
    }

    /// The name, as in the environment variable.
    pub fn name(self) -> &'static str {
        match self {
            Self::Portable => "portable",
            Self::Neon => "neon",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
        }
    }

    /// Runs `op` with this width, or with the portable one if the processor lacks it.
    #[inline(always)]
    pub fn run<Op: WithSimd>(self, op: Op) -> Op::Output {
        self.arch().unwrap_or(Arch::Scalar).dispatch(op)
    }

    fn arch(self) -> Option<Arch> {
        match self {
            Self::Portable => Some(Arch::Scalar),
            #[cfg(target_arch = "aarch64")]
            Self::Neon => pulp::aarch64::Neon::try_new().map(Arch::Neon),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => pulp::x86::V3::try_new().map(Arch::V3),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => pulp::x86::V4::try_new().map(Arch::V4),
            _ => None,
        }
    }
}

/// Runs `f`, compiled for the [current](VectorWidth::current) width. Functions that `f` calls must be `inline(always)`; others are
/// compiled for the baseline processor.
#[inline(always)]
pub fn simd<R>(f: impl FnOnce() -> R) -> R {
    // Not generic over `WithSimd`: a closure that is not known to be `FnOnce` is called through a function for the baseline.
    dispatch(f)
}

/// Runs `op` with the [current](VectorWidth::current) width.
#[inline(always)]
pub(super) fn dispatch<Op: WithSimd>(op: Op) -> Op::Output {
    static CURRENT: OnceLock<Arch> = OnceLock::new();
    CURRENT.get_or_init(|| VectorWidth::current().arch().unwrap_or(Arch::Scalar)).dispatch(op)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn widths_are_ordered_and_the_portable_one_is_everywhere() {
        assert!(VectorWidth::ALL.is_sorted());
        let available = VectorWidth::available();
        assert_eq!(available[0], VectorWidth::Portable);
        assert!(available.contains(&VectorWidth::current()));
    }
}
