"""Small ONNX graphs with the exact ports of the networks, whose answers are known."""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper


def save(path, nodes, inputs, outputs, constants=()):
    """Writes a graph; ports are (name, shape) with None for a free size."""

    def port(name, shape):
        dims = [f"{name}{i}" if size is None else size for i, size in enumerate(shape)]
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, dims)

    graph = helper.make_graph(
        nodes,
        "test",
        [port(*p) for p in inputs],
        [port(*p) for p in outputs],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 14)])
    model.ir_version = 8
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return path


def channel_mean(path, input_name="image", output_name="depth", side=(None, None), factor=1.0, rank=4):
    """Output = factor x mean over the three channels: what arrives in the network can be read off."""
    h, w = side
    nodes = [
        helper.make_node("ReduceMean", [input_name], ["mean"], axes=[1], keepdims=1 if rank == 4 else 0),
        helper.make_node("Mul", ["mean", "factor"], [output_name]),
    ]
    shape = (None, 1, h, w) if rank == 4 else (None, h, w)
    return save(
        path, nodes, [(input_name, (None, 3, h, w))], [(output_name, shape)], [("factor", np.float32(factor))]
    )


def constant_depth(path, value, input_name="image", output_name="depth"):
    """Output = value everywhere, whatever comes in."""
    nodes = [
        helper.make_node("ReduceMean", [input_name], ["mean"], axes=[1], keepdims=1),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "value"], [output_name]),
    ]
    return save(
        path,
        nodes,
        [(input_name, (None, 3, None, None))],
        [(output_name, (None, 1, None, None))],
        [("zero", np.float32(0.0)), ("value", np.float32(value))],
    )


def unidepth(path, side=(28, 42), with_rays=True):
    """pts_3d = 3 x rays (so that |point| = 3 m), confidence = 0.25; without rays pts_3d = rgbs."""
    h, w = side
    inputs = [("rgbs", (None, 3, h, w))] + ([("rays", (None, 3, h, w))] if with_rays else [])
    nodes = [
        helper.make_node("Mul", ["rays" if with_rays else "rgbs", "three"], ["scaled"]),
        helper.make_node("ReduceMean", ["rgbs"], ["mean"], axes=[1], keepdims=1),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "quarter"], ["confidence"]),
        helper.make_node("Add", ["scaled", "nothing"], ["pts_3d"]),
        helper.make_node("Identity", ["K"], ["intrinsics"]),
    ]
    return save(
        path,
        nodes,
        inputs,
        [("pts_3d", (None, 3, h, w)), ("confidence", (None, 1, h, w)), ("intrinsics", (1, 3, 3))],
        [
            ("three", np.float32(3.0)),
            ("zero", np.float32(0.0)),
            ("quarter", np.float32(0.25)),
            ("K", np.eye(3, dtype=np.float32)[None]),
        ],
    )
