//! The mixing layer of `qmix` and `invariant`, given the weights that the hypernetworks produce (docs/model.md, "Mixers"):
//!
//! ```text
//! Q_tot = |w2| . ELU(sum_i q_i |w1_i| + b1) + b2
//! ```

use crate::nn::{Real, elu, elu_slope};

/// E, the width of the mixing layer.
pub(super) const E: usize = 32;

/// Writes Q_tot of every slot. `mixed` is b1 on entry and the output of the ELU on return. `uavs` is M.
#[inline(always)]
pub(super) fn mix<T: Real>((w1, w2, b2): (&[T], &[T], &[T]), (q, uavs): (&[T], usize), mixed: &mut [T], total: &mut [T]) {
    let (w1, w2) = (w1.as_chunks::<E>().0, w2.as_chunks::<E>().0);
    for (slot, (mixed, total)) in mixed.as_chunks_mut::<E>().0.iter_mut().zip(total).enumerate() {
        for (w1, &q) in w1[slot * uavs..][..uavs].iter().zip(&q[slot * uavs..]) {
            for e in 0..E {
                mixed[e] = q.mul_add(w1[e].abs(), mixed[e]);
            }
        }
        let mut sum = T::ZERO;
        let mut terms = [T::ZERO; E];
        for e in 0..E {
            mixed[e] = elu(mixed[e]);
            terms[e] = mixed[e] * w2[slot][e].abs();
        }
        for x in terms {
            sum += x;
        }
        *total = sum + b2[slot];
    }
}

/// Replaces w1, w2 and mixed by their gradients and writes the gradients of the values.
#[inline(always)]
pub(super) fn mix_back<T: Real>(
    (w1, w2, mixed): (&mut [T], &mut [T], &mut [T]),
    (q, uavs): (&[T], usize),
    d_total: &[T],
    dq: &mut [T],
) {
    let (w1, w2) = (w1.as_chunks_mut::<E>().0, w2.as_chunks_mut::<E>().0);
    for (slot, (mixed, &d)) in mixed.as_chunks_mut::<E>().0.iter_mut().zip(d_total).enumerate() {
        let w2 = &mut w2[slot];
        for e in 0..E {
            let y = mixed[e];
            mixed[e] = d * w2[e].abs() * elu_slope(y);
            w2[e] = d * y * sign(w2[e]);
        }
        for i in slot * uavs..(slot + 1) * uavs {
            let w1 = &mut w1[i];
            let mut terms = [T::ZERO; E];
            for e in 0..E {
                terms[e] = mixed[e] * w1[e].abs();
                w1[e] = mixed[e] * q[i] * sign(w1[e]);
            }
            let mut sum = T::ZERO;
            for x in terms {
                sum += x;
            }
            dq[i] = sum;
        }
    }
}

/// -1, 0 or 1.
#[inline(always)]
fn sign<T: Real>(x: T) -> T {
    if x > T::ZERO {
        T::ONE
    } else if x < T::ZERO {
        -T::ONE
    } else {
        T::ZERO
    }
}
