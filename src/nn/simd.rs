//! Chooses the processor's vector units at run time.

/// Runs `f`, compiled for the widest vector unit of this processor. Functions that `f` calls must be `inline(always)`; others are
/// compiled for the baseline processor.
#[inline(always)]
pub fn simd<R>(f: impl FnOnce() -> R) -> R {
    pulp::Arch::new().dispatch(f)
}
