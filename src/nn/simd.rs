//! Chooses the processor's vector units at run time.

/// Runs `f` compiled for the widest vector unit of this processor. What `f` calls must be `inline(always)` to profit.
#[inline(always)]
pub fn simd<R>(f: impl FnOnce() -> R) -> R {
    pulp::Arch::new().dispatch(f)
}
