//! Outputs of inference: headings, Q-values and the recurrent state.

use super::STATE;
use crate::api::convert::tensors::{Data, Datatype, Tensor, TensorShape};
use crate::invalid::Invalid;
use crate::service::act::Response;
use crate::serving::flight::degrees;

const NAMES: [&str; 4] = [INDEX, DEGREES, Q_VALUES, STATE];
const INDEX: &str = "heading_index";
const DEGREES: &str = "heading_deg";
const Q_VALUES: &str = "q_values";

/// The outputs that a request selects; empty for all.
pub(super) struct OutputSelection(Vec<String>);

impl OutputSelection {
    /// Checks the requested names. `stateless`: the caller keeps the recurrent state.
    ///
    /// # Errors
    /// [`Invalid`] for an unknown or repeated name, or for the state of a sequence.
    pub(super) fn new(names: Vec<String>, stateless: bool) -> Result<Self, Invalid> {
        for (i, name) in names.iter().enumerate() {
            let invalid = |expected: &str| Invalid::new(format!("outputs[{i}].name"), format!("{name:?}"), expected);
            if !NAMES.contains(&name.as_str()) {
                return Err(invalid(&format!("one of {}", NAMES.join(", "))));
            }
            if name == STATE && !stateless {
                return Err(invalid("another output, because the server keeps the state of a sequence"));
            }
            if names[..i].contains(name) {
                return Err(invalid("each output once"));
            }
        }
        Ok(Self(names))
    }

    /// The selected tensors, with the UAVs in the order of the request.
    pub(super) fn tensors(self, response: Response) -> Vec<Tensor> {
        let names = if self.0.is_empty() {
            let values = response.decision.q_values.iter().all(|value| !value.is_nan());
            let available = |name: &&str| (*name != Q_VALUES || values) && (*name != STATE || response.recurrent_state.is_some());
            NAMES.iter().filter(|name| available(name)).map(|name| (*name).to_owned()).collect()
        } else {
            self.0
        };
        names.into_iter().map(|name| output(name, &response)).collect()
    }
}

fn output(name: String, response: &Response) -> Tensor {
    let uavs = response.canonical_of_request.len() as i64;
    let uav_indices = response.canonical_of_request.iter().map(|&uav| uav as usize);
    let heading = |uav: usize| response.decision.headings[uav];
    let actions = response.policy.implementation.actions();
    let (shape, data) = match name.as_str() {
        INDEX => (vec![uavs], Data::Int32(uav_indices.map(|uav| i32::from(heading(uav))).collect())),
        // Hovering has no direction.
        DEGREES => {
            let degrees =
                |uav| response.flight.as_ref().map_or_else(|| degrees(heading(uav)), |flight| flight.degrees(heading(uav)));
            (vec![uavs], Data::Fp32(uav_indices.map(|uav| degrees(uav).map_or(f32::NAN, |x| x as f32)).collect()))
        }
        Q_VALUES => {
            let values =
                uav_indices.flat_map(|uav| response.decision.q_values[uav * actions..(uav + 1) * actions].iter().copied());
            (vec![uavs, actions as i64], Data::Fp32(values.collect()))
        }
        _ => (vec![1], Data::Bytes(vec![response.recurrent_state.clone().unwrap_or_default()])),
    };
    let datatype = data.datatype().map_or("", |datatype| datatype.name()).to_owned();
    Tensor { name, datatype, shape, data }
}

/// The outputs of a policy with `actions` actions for `uavs` UAVs (-1: any number). `has_values`: the policy has Q-values.
pub(super) fn shapes(uavs: i64, actions: i64, has_values: bool) -> impl Iterator<Item = TensorShape> {
    let tensor = |name, datatype, shape| TensorShape { name, datatype, shape, optional: false };
    let all = [
        tensor(INDEX, Datatype::Int32, vec![uavs]),
        tensor(DEGREES, Datatype::Fp32, vec![uavs]),
        tensor(Q_VALUES, Datatype::Fp32, vec![uavs, actions]),
        tensor(STATE, Datatype::Bytes, vec![1]),
    ];
    all.into_iter().filter(move |tensor| tensor.name != Q_VALUES || has_values)
}
