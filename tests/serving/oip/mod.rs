//! The Open Inference Protocol over gRPC and HTTP: the same actions as `Act`, sequences, and what is refused.

mod http;
mod sequences;
mod tensors;

use std::collections::HashMap;

use bytes::{BufMut, Bytes, BytesMut};
use qedgix::wire::oip;
use qedgix::wire::oip::grpc_inference_service_client::GrpcInferenceServiceClient;
use qedgix::wire::oip::infer_parameter::ParameterChoice;
use qedgix::wire::v1;
use tonic::transport::Channel;

use super::harness::*;

/// How values travel.
#[derive(Clone, Copy, Debug, PartialEq)]
enum As {
    Raw,
    Typed,
}

/// A request and how its next tensors are written.
struct Ask {
    request: oip::ModelInferRequest,
    how: As,
    /// In 64 bits, or in 32.
    wide: bool,
}

impl Ask {
    fn new(model: &str, how: As, wide: bool) -> Self {
        Self { request: oip::ModelInferRequest { model_name: model.into(), ..Default::default() }, how, wide }
    }

    fn tensor(&mut self, name: &str, shape: &[usize], datatype: &str, contents: oip::InferTensorContents, raw: BytesMut) {
        let contents = (self.how == As::Typed).then_some(contents);
        let shape = shape.iter().map(|&size| size as i64).collect();
        let tensor = oip::model_infer_request::InferInputTensor {
            name: name.into(),
            datatype: datatype.into(),
            shape,
            parameters: HashMap::new(),
            contents,
        };
        self.request.inputs.push(tensor);
        if self.how == As::Raw {
            self.request.raw_input_contents.push(raw.freeze());
        }
    }

    fn numbers(mut self, name: &str, shape: &[usize], values: &[f64]) -> Self {
        let (mut contents, mut raw) = (oip::InferTensorContents::default(), BytesMut::new());
        if self.wide {
            contents.fp64_contents = values.to_vec();
            values.iter().for_each(|&value| raw.put_f64_le(value));
        } else {
            contents.fp32_contents = values.iter().map(|&value| value as f32).collect();
            values.iter().for_each(|&value| raw.put_f32_le(value as f32));
        }
        self.tensor(name, shape, if self.wide { "FP64" } else { "FP32" }, contents, raw);
        self
    }

    fn integers(mut self, name: &str, shape: &[usize], values: &[usize]) -> Self {
        let (mut contents, mut raw) = (oip::InferTensorContents::default(), BytesMut::new());
        if self.wide {
            contents.int64_contents = values.iter().map(|&value| value as i64).collect();
            values.iter().for_each(|&value| raw.put_i64_le(value as i64));
        } else {
            contents.int_contents = values.iter().map(|&value| value as i32).collect();
            values.iter().for_each(|&value| raw.put_i32_le(value as i32));
        }
        self.tensor(name, shape, if self.wide { "INT64" } else { "INT32" }, contents, raw);
        self
    }

    fn byte_strings<T: AsRef<[u8]>>(mut self, name: &str, values: &[T]) -> Self {
        let (mut contents, mut raw) = (oip::InferTensorContents::default(), BytesMut::new());
        for value in values.iter().map(AsRef::as_ref) {
            contents.bytes_contents.push(Bytes::copy_from_slice(value));
            raw.put_u32_le(value.len() as u32);
            raw.put_slice(value);
        }
        self.tensor(name, &[values.len()], "BYTES", contents, raw);
        self
    }

    /// A scene without its ids.
    fn scene(self, scene: &v1::Scene) -> Self {
        let uavs: Vec<f64> = scene.uavs.iter().flat_map(|u| [u.x, u.y]).collect();
        let users: Vec<f64> = scene.users.iter().flat_map(|u| [u.x, u.y]).collect();
        self.numbers("uav_positions", &[scene.uavs.len(), 2], &uavs)
            .numbers("user_positions", &[scene.users.len(), 2], &users)
            .ages(scene)
    }

    fn ages(self, scene: &v1::Scene) -> Self {
        let ages: Vec<f64> = scene.users.iter().map(|u| u.aoi).collect();
        self.numbers("user_aoi", &[ages.len()], &ages)
    }

    fn ids(self, scene: &v1::Scene) -> Self {
        let uavs: Vec<&str> = scene.uavs.iter().map(|u| u.id.as_str()).collect();
        let users: Vec<&str> = scene.users.iter().map(|u| u.id.as_str()).collect();
        self.byte_strings("uav_ids", &uavs).byte_strings("user_ids", &users)
    }

    fn with(mut self, name: &str, value: ParameterChoice) -> Self {
        self.request.parameters.insert(name.into(), oip::InferParameter { parameter_choice: Some(value) });
        self
    }

    fn int(self, name: &str, value: i64) -> Self {
        self.with(name, ParameterChoice::Int64Param(value))
    }

    fn flag(self, name: &str) -> Self {
        self.with(name, ParameterChoice::BoolParam(true))
    }

    fn asking(mut self, names: &[&str]) -> Self {
        let output = |name: &&str| oip::model_infer_request::InferRequestedOutputTensor {
            name: (*name).into(),
            parameters: HashMap::new(),
        };
        self.request.outputs = names.iter().map(output).collect();
        self
    }
}

/// A scene whose coordinates are numbers of 32 bits, so that both widths say the same.
fn narrow(uavs: usize, users: usize, seed: u64) -> v1::Scene {
    let mut scene = scene(uavs, users, seed);
    let round = |x: &mut f64| *x = f64::from(*x as f32);
    scene.uavs.iter_mut().for_each(|u| [&mut u.x, &mut u.y].into_iter().for_each(round));
    scene.users.iter_mut().for_each(|u| [&mut u.x, &mut u.y].into_iter().for_each(round));
    scene
}

async fn client(server: &Server) -> GrpcInferenceServiceClient<Channel> {
    let large = 64 << 20;
    GrpcInferenceServiceClient::new(server.channel().await).max_decoding_message_size(large).max_encoding_message_size(large)
}

fn raw<'a>(answer: &'a oip::ModelInferResponse, name: &str) -> Option<(&'a [i64], &'a [u8])> {
    assert_eq!(answer.outputs.len(), answer.raw_output_contents.len(), "values are raw");
    assert!(answer.outputs.iter().all(|output| output.contents.is_none()));
    let at = answer.outputs.iter().position(|output| output.name == name)?;
    Some((&answer.outputs[at].shape, &answer.raw_output_contents[at]))
}

fn indices(answer: &oip::ModelInferResponse) -> Vec<u32> {
    let (shape, raw) = raw(answer, "heading_index").unwrap();
    let values: Vec<u32> = raw.chunks_exact(4).map(|b| u32::from_le_bytes(b.try_into().unwrap())).collect();
    assert_eq!(shape, [values.len() as i64]);
    values
}

fn floats(answer: &oip::ModelInferResponse, name: &str) -> Vec<f32> {
    let (shape, raw) = raw(answer, name).unwrap();
    let values: Vec<f32> = raw.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    assert_eq!(shape.iter().product::<i64>(), values.len() as i64);
    values
}

fn state(answer: &oip::ModelInferResponse) -> Bytes {
    let (shape, raw) = raw(answer, "recurrent_state").unwrap();
    assert_eq!((shape, raw.len()), (&[1][..], 4 + u32::from_le_bytes(raw[..4].try_into().unwrap()) as usize));
    Bytes::copy_from_slice(&raw[4..])
}
