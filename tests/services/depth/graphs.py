"""Small ONNX graphs with the exact ports of the networks, whose answers are known."""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper


def save(path, nodes, inputs, outputs, constants=(), types=None, data=None):
    """Writes a graph; ports are (name, shape) with None for a free size, `types` those that are not float.

    `data`: name of a second file for the constants, as exporters of large networks write it.
    """

    def port(name, shape):
        dims = [f"{name}{i}" if size is None else size for i, size in enumerate(shape)]
        return helper.make_tensor_value_info(name, (types or {}).get(name, TensorProto.FLOAT), dims)

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
    if data:
        onnx.save(model, path, save_as_external_data=True, location=data, size_threshold=0)
    else:
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


def moge(
    path, side=(None, None), tokens=True, outputs=("points", "normal", "mask", "metric_scale"), seen=False
):
    """MoGe-2, whose image brings what a network would find in it.

    Red is (x / z + 1) / 2, green (y / z + 1) / 2, blue z / 8. Output: points = (x, y, z - 0.75) in units of
    1.25 m, mask = 0.9, but 0.1 where blue is 0. `seen`: metric_scale is num_tokens / 1000, to read it off.
    """
    h, w = side
    inputs = [("image", (None, 3, h, w))]
    nodes = [
        helper.make_node("Split", ["image"], ["red", "green", "blue"], axis=1),
        helper.make_node("Mul", ["blue", "eight"], ["z"]),
        helper.make_node("Mul", ["red", "two"], ["red2"]),
        helper.make_node("Sub", ["red2", "one"], ["ray_x"]),
        helper.make_node("Mul", ["green", "two"], ["green2"]),
        helper.make_node("Sub", ["green2", "one"], ["ray_y"]),
        helper.make_node("Mul", ["ray_x", "z"], ["x"]),
        helper.make_node("Mul", ["ray_y", "z"], ["y"]),
        helper.make_node("Sub", ["z", "shift"], ["z_shifted"]),
        helper.make_node("Concat", ["x", "y", "z_shifted"], ["xyz"], axis=1),
        helper.make_node("Transpose", ["xyz"], ["points"], perm=[0, 2, 3, 1]),
        helper.make_node("Identity", ["points"], ["normal"]),
        helper.make_node("Greater", ["blue", "zero"], ["there"]),
        helper.make_node("Cast", ["there"], ["there_f"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["there_f", "most"], ["mask4"]),
        helper.make_node("Add", ["mask4", "least"], ["mask5"]),
        helper.make_node("Squeeze", ["mask5", "axis1"], ["mask"]),
    ]
    if tokens:
        inputs.append(("num_tokens", ()))
    if tokens and seen:
        nodes += [
            helper.make_node("Cast", ["num_tokens"], ["tokens_f"], to=TensorProto.FLOAT),
            helper.make_node("Mul", ["tokens_f", "thousandth"], ["tokens_1"]),
            helper.make_node("Reshape", ["tokens_1", "axis1"], ["metric_scale"]),
        ]
    else:
        nodes.append(helper.make_node("Identity", ["scale"], ["metric_scale"]))
    shapes = {
        "points": (None, h, w, 3), "normal": (None, h, w, 3), "mask": (None, h, w), "metric_scale": (None,),
    }  # fmt: skip
    constants = [
        ("eight", np.float32(8.0)), ("two", np.float32(2.0)), ("one", np.float32(1.0)),
        ("zero", np.float32(0.0)), ("shift", np.float32(0.75)), ("most", np.float32(0.8)),
        ("least", np.float32(0.1)), ("thousandth", np.float32(1e-3)), ("axis1", np.array([1], np.int64)),
        ("scale", np.array([1.25], np.float32)),
    ]  # fmt: skip
    return save(
        path,
        nodes,
        inputs,
        [(name, shapes[name]) for name in outputs],
        constants,
        {"num_tokens": TensorProto.INT64},
    )


def depth_anything_3(
    path, side=(None, None), views=True, names=("predicted_depth", "confidence"), sky=False, data=None
):
    """Depth = mean of the normalised channels + 3, confidence = 3; with views [1, N, 3, h, w], as DA3 exports.

    With `sky`, sky = 1 where the depth is above 4.5.
    """
    h, w = side
    shape = (None, None, 3, h, w) if views else (None, 3, h, w)
    out = (None, None, h, w)
    nodes = [
        helper.make_node(
            "ReduceMean", ["pixel_values"], ["mean"], axes=[2 if views else 1], keepdims=int(not views)
        ),
        helper.make_node("Add", ["mean", "three"], [names[0]]),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "three"], [names[1]]),
    ]
    outputs = [(names[0], out), (names[1], out)]
    if views:
        nodes += [helper.make_node("Identity", [n], [n[:-2]]) for n in ("extrinsics_c", "intrinsics_c")]
        outputs += [("extrinsics", (1, 1, 3, 4)), ("intrinsics", (1, 1, 3, 3))]
    if sky:
        nodes += [
            helper.make_node("Greater", [names[0], "high"], ["above"]),
            helper.make_node("Cast", ["above"], ["sky"], to=TensorProto.FLOAT),
        ]
        outputs.append(("sky", out))
    constants = [
        ("three", np.float32(3.0)), ("zero", np.float32(0.0)), ("high", np.float32(4.5)),
        ("extrinsics_c", np.eye(4, dtype=np.float32)[None, None, :3]),
        ("intrinsics_c", np.eye(3, dtype=np.float32)[None, None]),
    ]  # fmt: skip
    return save(path, nodes, [("pixel_values", shape)], outputs, constants, data=data)
