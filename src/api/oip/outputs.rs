//! Outputs: headings, values, memory.

use super::STATE;
use crate::api::convert::response::degrees;
use crate::api::convert::tensors::{Data, Datatype, Tensor, TensorShape};
use crate::invalid::Invalid;
use crate::service::act::Answer;

const NAMES: [&str; 4] = [INDEX, DEGREES, VALUES, STATE];
const INDEX: &str = "heading_index";
const DEGREES: &str = "heading_deg";
const VALUES: &str = "q_values";

/// Which outputs a request asks for; none: all there are.
pub(super) struct Outputs(Vec<String>);

impl Outputs {
    /// Checks the names asked for. `held`: the caller keeps the memory.
    ///
    /// # Errors
    /// An unknown name, one that is there twice, or the memory of a sequence.
    pub(super) fn asked(names: Vec<String>, held: bool) -> Result<Self, Invalid> {
        for (i, name) in names.iter().enumerate() {
            let wrong = |expected: &str| Invalid::new(format!("outputs[{i}].name"), format!("{name:?}"), expected);
            if !NAMES.contains(&name.as_str()) {
                return Err(wrong(&format!("one of {}", NAMES.join(", "))));
            }
            if name == STATE && !held {
                return Err(wrong("another output: the server keeps the memory of a sequence"));
            }
            if names[..i].contains(name) {
                return Err(wrong("each output once"));
            }
        }
        Ok(Self(names))
    }

    /// The tensors, UAVs in the order of the request.
    pub(super) fn of(self, answer: Answer) -> Vec<Tensor> {
        let names = if self.0.is_empty() {
            let values = answer.q_values.iter().all(|value| !value.is_nan());
            let there = |name: &&str| (*name != VALUES || values) && (*name != STATE || answer.state.is_some());
            NAMES.iter().filter(|name| there(name)).map(|name| (*name).to_owned()).collect()
        } else {
            self.0
        };
        names.into_iter().map(|name| output(name, &answer)).collect()
    }
}

fn output(name: String, answer: &Answer) -> Tensor {
    let uavs = answer.order.len() as i64;
    let order = answer.order.iter().map(|&uav| uav as usize);
    let heading = |uav: usize| answer.headings[uav];
    let actions = answer.policy.policy.actions();
    let (shape, data) = match name.as_str() {
        INDEX => (vec![uavs], Data::Int32(order.map(|uav| i32::from(heading(uav))).collect())),
        // No direction is what hovering has.
        DEGREES => (vec![uavs], Data::Fp32(order.map(|uav| degrees(heading(uav)).map_or(f32::NAN, |x| x as f32)).collect())),
        VALUES => {
            let values = order.flat_map(|uav| answer.q_values[uav * actions..(uav + 1) * actions].iter().copied());
            (vec![uavs, actions as i64], Data::Fp32(values.collect()))
        }
        _ => (vec![1], Data::Bytes(vec![answer.state.clone().unwrap_or_default()])),
    };
    let datatype = data.datatype().map_or("", |datatype| datatype.name()).to_owned();
    Tensor { name, datatype, shape, data }
}

/// The outputs of a policy of `actions` actions that flies `uavs` UAVs, -1 for any number; `values`: it has Q-values.
pub(super) fn described(uavs: i64, actions: i64, values: bool) -> impl Iterator<Item = TensorShape> {
    let tensor = |name, datatype, shape| TensorShape { name, datatype, shape, optional: false };
    let all = [
        tensor(INDEX, Datatype::Int32, vec![uavs]),
        tensor(DEGREES, Datatype::Fp32, vec![uavs]),
        tensor(VALUES, Datatype::Fp32, vec![uavs, actions]),
        tensor(STATE, Datatype::Bytes, vec![1]),
    ];
    all.into_iter().filter(move |tensor| tensor.name != VALUES || values)
}
