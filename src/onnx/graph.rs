//! Builds the graph of an ONNX model: nodes, constants, inputs and outputs. One method per operator that is used, with the names of the
//! operators of ONNX (opset 17).

use crate::wire::onnx as wire;
use wire::attribute_proto::AttributeType;
use wire::tensor_proto::DataType;
use wire::tensor_shape_proto::{Dimension, dimension};

/// A tensor of the graph.
#[derive(Clone, Debug)]
pub(super) struct Tensor(String);

/// A dimension of an input or output: fixed, or a symbol that is the same wherever it occurs.
#[derive(Clone, Copy, Debug)]
pub(super) enum Dim {
    Fixed(i64),
    Symbol(&'static str),
}

/// The graph.
#[derive(Debug, Default)]
pub(super) struct Graph {
    graph: wire::GraphProto,
    next: usize,
}

fn int(name: &str, i: i64) -> wire::AttributeProto {
    wire::AttributeProto { name: name.into(), r#type: AttributeType::Int.into(), i, ..Default::default() }
}

fn ints(name: &str, ints: &[i64]) -> wire::AttributeProto {
    wire::AttributeProto { name: name.into(), r#type: AttributeType::Ints.into(), ints: ints.to_vec(), ..Default::default() }
}

fn float(name: &str, f: f32) -> wire::AttributeProto {
    wire::AttributeProto { name: name.into(), r#type: AttributeType::Float.into(), f, ..Default::default() }
}

fn string(name: &str, s: &str) -> wire::AttributeProto {
    let r#type = AttributeType::String.into();
    wire::AttributeProto { name: name.into(), r#type, s: s.as_bytes().to_vec(), ..Default::default() }
}

impl Graph {
    /// The model with this graph.
    pub(super) fn finish(mut self, name: &str, description: &str, metadata: Vec<(&str, String)>) -> wire::ModelProto {
        name.clone_into(&mut self.graph.name);
        let entry = |(key, value): (&str, String)| wire::StringStringEntryProto { key: key.to_owned(), value };
        wire::ModelProto {
            ir_version: 8,
            opset_import: vec![wire::OperatorSetIdProto { domain: String::new(), version: 17 }],
            producer_name: "qedgix".into(),
            producer_version: env!("CARGO_PKG_VERSION").into(),
            doc_string: description.to_owned(),
            graph: Some(self.graph),
            metadata_props: metadata.into_iter().map(entry).collect(),
            ..Default::default()
        }
    }

    fn info(name: &str, kind: DataType, shape: &[Dim], text: &str) -> wire::ValueInfoProto {
        let dim = |dim: &Dim| Dimension {
            value: Some(match *dim {
                Dim::Fixed(size) => dimension::Value::DimValue(size),
                Dim::Symbol(name) => dimension::Value::DimParam(name.to_owned()),
            }),
        };
        let shape = Some(wire::TensorShapeProto { dim: shape.iter().map(dim).collect() });
        let tensor = wire::type_proto::Tensor { elem_type: kind.into(), shape };
        wire::ValueInfoProto {
            name: name.to_owned(),
            r#type: Some(wire::TypeProto { value: Some(wire::type_proto::Value::TensorType(tensor)) }),
            doc_string: text.to_owned(),
        }
    }

    /// An input of the model.
    pub(super) fn input(&mut self, name: &str, kind: DataType, shape: &[Dim], text: &str) -> Tensor {
        self.graph.input.push(Self::info(name, kind, shape, text));
        Tensor(name.to_owned())
    }

    /// Makes `tensor` an output of the model.
    pub(super) fn output(&mut self, tensor: &Tensor, name: &str, (kind, shape): (DataType, &[Dim]), text: &str) {
        self.graph.output.push(Self::info(name, kind, shape, text));
        self.node("Identity", &[tensor], vec![], name.to_owned());
    }

    fn node(&mut self, op: &str, inputs: &[&Tensor], attribute: Vec<wire::AttributeProto>, output: String) {
        let input = inputs.iter().map(|tensor| tensor.0.clone()).collect();
        let name = format!("{op}_{}", self.graph.node.len());
        let op_type = op.to_owned();
        self.graph.node.push(wire::NodeProto { input, output: vec![output], name, op_type, attribute, ..Default::default() });
    }

    fn name(&mut self) -> String {
        self.next += 1;
        format!("t{}", self.next)
    }

    fn op(&mut self, op: &str, inputs: &[&Tensor], attributes: Vec<wire::AttributeProto>) -> Tensor {
        let output = self.name();
        self.node(op, inputs, attributes, output.clone());
        Tensor(output)
    }

    fn constant(&mut self, kind: DataType, dims: &[i64], raw_data: Vec<u8>) -> Tensor {
        let name = self.name();
        let tensor =
            wire::TensorProto { dims: dims.to_vec(), data_type: kind.into(), name: name.clone(), raw_data, ..Default::default() };
        self.graph.initializer.push(tensor);
        Tensor(name)
    }

    /// A constant of f32.
    pub(super) fn floats(&mut self, dims: &[i64], values: &[f32]) -> Tensor {
        self.constant(DataType::Float, dims, values.iter().flat_map(|x| x.to_le_bytes()).collect())
    }

    /// A constant of f64.
    pub(super) fn doubles(&mut self, dims: &[i64], values: &[f64]) -> Tensor {
        self.constant(DataType::Double, dims, values.iter().flat_map(|x| x.to_le_bytes()).collect())
    }

    /// A constant of integers.
    pub(super) fn ints(&mut self, dims: &[i64], values: &[i64]) -> Tensor {
        self.constant(DataType::Int64, dims, values.iter().flat_map(|x| x.to_le_bytes()).collect())
    }

    /// A constant of truth values.
    pub(super) fn bools(&mut self, dims: &[i64], values: &[bool]) -> Tensor {
        self.constant(DataType::Bool, dims, values.iter().map(|&x| u8::from(x)).collect())
    }

    /// A vector of integers, such as a shape.
    pub(super) fn list(&mut self, values: &[i64]) -> Tensor {
        self.ints(&[values.len() as i64], values)
    }

    /// An f32.
    pub(super) fn float(&mut self, value: f32) -> Tensor {
        self.floats(&[], &[value])
    }

    /// An f64.
    pub(super) fn double(&mut self, value: f64) -> Tensor {
        self.doubles(&[], &[value])
    }

    /// An integer.
    pub(super) fn integer(&mut self, value: i64) -> Tensor {
        self.ints(&[], &[value])
    }

    /// An elementwise operator of one operand: `Relu`, `Sqrt`, ...
    pub(super) fn map(&mut self, op: &str, x: &Tensor) -> Tensor {
        self.op(op, &[x], vec![])
    }

    /// An elementwise operator of two operands, which are broadcast: `Add`, `Less`, `MatMul` as well.
    pub(super) fn with(&mut self, op: &str, a: &Tensor, b: &Tensor) -> Tensor {
        self.op(op, &[a, b], vec![])
    }

    /// a if `condition`, else b; of f32 and integers.
    pub(super) fn select(&mut self, condition: &Tensor, a: &Tensor, b: &Tensor) -> Tensor {
        self.op("Where", &[condition, a, b], vec![])
    }

    /// x if x > 0, else `slope` x.
    pub(super) fn leaky_relu(&mut self, x: &Tensor, slope: f32) -> Tensor {
        self.op("LeakyRelu", &[x], vec![float("alpha", slope)])
    }

    /// x W^T + b.
    pub(super) fn linear(&mut self, x: &Tensor, weight: &Tensor, bias: &Tensor) -> Tensor {
        self.op("Gemm", &[x, weight, bias], vec![int("transB", 1)])
    }

    /// The transpose of a matrix.
    pub(super) fn transpose(&mut self, x: &Tensor) -> Tensor {
        self.op("Transpose", &[x], vec![])
    }

    /// The rows of x, normalised, scaled and shifted.
    pub(super) fn layer_norm(&mut self, x: &Tensor, scale: &Tensor, shift: &Tensor) -> Tensor {
        self.op("LayerNormalization", &[x, scale, shift], vec![int("axis", -1), float("epsilon", 1e-5)])
    }

    /// Another element type.
    pub(super) fn cast(&mut self, x: &Tensor, to: DataType) -> Tensor {
        self.op("Cast", &[x], vec![int("to", i64::from(i32::from(to)))])
    }

    /// Joined along an axis.
    pub(super) fn concat(&mut self, parts: &[&Tensor], axis: i64) -> Tensor {
        self.op("Concat", parts, vec![int("axis", axis)])
    }

    /// x[from..to] of one axis; `to` of [`i64::MAX`] stands for the end.
    pub(super) fn slice(&mut self, x: &Tensor, axis: i64, from: i64, to: i64) -> Tensor {
        let (from, to) = (self.list(&[from]), self.list(&[to]));
        self.slice_at(x, axis, &from, &to)
    }

    /// As [`Graph::slice`], with bounds of the graph, each a vector of one.
    pub(super) fn slice_at(&mut self, x: &Tensor, axis: i64, from: &Tensor, to: &Tensor) -> Tensor {
        let axis = self.list(&[axis]);
        self.op("Slice", &[x, from, to, &axis], vec![])
    }

    /// x[.., index] of the last axis, without that axis.
    pub(super) fn column(&mut self, x: &Tensor, index: i64) -> Tensor {
        let index = self.integer(index);
        self.op("Gather", &[x, &index], vec![int("axis", -1)])
    }

    /// The rows of x with these indices.
    pub(super) fn gather(&mut self, x: &Tensor, indices: &Tensor) -> Tensor {
        self.op("Gather", &[x, indices], vec![int("axis", 0)])
    }

    /// The elements or slices of x at index tuples, the last axis of `indices`.
    pub(super) fn gather_nd(&mut self, x: &Tensor, indices: &Tensor) -> Tensor {
        self.op("GatherND", &[x, indices], vec![])
    }

    /// x with `updates` at index tuples; `add`: added there.
    pub(super) fn scatter(&mut self, x: &Tensor, indices: &Tensor, updates: &Tensor, add: bool) -> Tensor {
        let attributes = if add { vec![string("reduction", "add")] } else { vec![] };
        self.op("ScatterND", &[x, indices, updates], attributes)
    }

    /// A further axis of size 1 at each of `axes`.
    pub(super) fn unsqueeze(&mut self, x: &Tensor, axes: &[i64]) -> Tensor {
        let axes = self.list(axes);
        self.op("Unsqueeze", &[x, &axes], vec![])
    }

    /// Another shape, given by a vector of the graph.
    pub(super) fn reshape(&mut self, x: &Tensor, shape: &Tensor) -> Tensor {
        self.op("Reshape", &[x, shape], vec![])
    }

    /// Broadcast to a shape, given by a vector of the graph.
    pub(super) fn expand(&mut self, x: &Tensor, shape: &Tensor) -> Tensor {
        self.op("Expand", &[x, shape], vec![])
    }

    /// Zeros of f32 in a shape, given by a vector of the graph.
    pub(super) fn zeros(&mut self, shape: &Tensor) -> Tensor {
        let zero = self.float(0.0);
        self.expand(&zero, shape)
    }

    /// The size of an axis, as a vector of one.
    pub(super) fn size(&mut self, x: &Tensor, axis: i64) -> Tensor {
        self.op("Shape", &[x], vec![int("start", axis), int("end", axis + 1)])
    }

    /// 0..n for n in a vector of one.
    pub(super) fn range(&mut self, n: &Tensor) -> Tensor {
        let axis = self.list(&[0]);
        let n = self.op("Squeeze", &[n, &axis], vec![]);
        let (zero, one) = (self.integer(0), self.integer(1));
        self.op("Range", &[&zero, &n, &one], vec![])
    }

    /// Sums over axes.
    pub(super) fn sum(&mut self, x: &Tensor, axes: &[i64], keep: bool) -> Tensor {
        let axes = self.list(axes);
        self.op("ReduceSum", &[x, &axes], vec![int("keepdims", i64::from(keep))])
    }

    /// The sums of the first 1, 2, ... elements along an axis, each added to the sum before it.
    pub(super) fn running_sum(&mut self, x: &Tensor, axis: i64) -> Tensor {
        let axis = self.integer(axis);
        self.op("CumSum", &[x, &axis], vec![])
    }

    /// Maxima over one axis, which is not empty.
    pub(super) fn max(&mut self, x: &Tensor, axis: i64, keep: bool) -> Tensor {
        self.op("ReduceMax", &[x], vec![ints("axes", &[axis]), int("keepdims", i64::from(keep))])
    }

    /// Minima over one axis, which is not empty.
    pub(super) fn min(&mut self, x: &Tensor, axis: i64) -> Tensor {
        self.op("ReduceMin", &[x], vec![ints("axes", &[axis]), int("keepdims", 0)])
    }

    /// The index of the first maximum along an axis, without that axis.
    pub(super) fn arg_max(&mut self, x: &Tensor, axis: i64) -> Tensor {
        self.op("ArgMax", &[x], vec![int("axis", axis), int("keepdims", 0), int("select_last_index", 0)])
    }
}
