"""Writes the tiny networks that the tests run: python3 tests/onnx/make.py (needs the package onnx)."""

from pathlib import Path

import numpy as np
from onnx import TensorProto, checker, external_data_helper, helper, numpy_helper, save

F = TensorProto.FLOAT
here = Path(__file__).parent


def write(name, nodes, inputs, outputs, weights=(), beside=None):
    graph = helper.make_graph(nodes, name, inputs, outputs, list(weights))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8, producer_name="tmpi")
    checker.check_model(model)
    if beside:
        (here / beside).unlink(missing_ok=True)
        external_data_helper.convert_model_to_external_data(model, location=beside, size_threshold=0)
    save(model, here / f"{name}.onnx")


def value(name, *shape, kind=F):
    return helper.make_tensor_value_info(name, kind, list(shape))


# Two inputs, two outputs: their sum and their difference
write(
    "sum_difference",
    [helper.make_node("Add", ["a", "b"], ["sum"]), helper.make_node("Sub", ["a", "b"], ["difference"])],
    [value("a", "n", 3), value("b", "n", 3)],
    [value("sum", "n", 3), value("difference", "n", 3)],
)
# A network whose input is not of 32-bit floats
write("integers", [helper.make_node("Neg", ["a"], ["b"])], [value("a", 2, kind=TensorProto.INT64)], [value("b", 2, kind=TensorProto.INT64)])
# A network of half precision at both ends
H = TensorProto.FLOAT16
write("half", [helper.make_node("Add", ["a", "a"], ["b"])], [value("a", "n", 3, kind=H)], [value("b", "n", 3, kind=H)])
# Mean of the three channels of an image: stands in for a depth network
write(
    "mean",
    [helper.make_node("ReduceMean", ["image"], ["disparity"], axes=[1], keepdims=1)],
    [value("image", 1, 3, "h", "w")],
    [value("disparity", 1, 1, "h", "w")],
)
# Mean difference of two images: stands in for LPIPS
write(
    "distance",
    [
        helper.make_node("Sub", ["in0", "in1"], ["difference"]),
        helper.make_node("Abs", ["difference"], ["size"]),
        helper.make_node("ReduceMean", ["size"], ["distance"], axes=[1, 2, 3], keepdims=1),
    ],
    [value("in0", 1, 3, "h", "w"), value("in1", 1, 3, "h", "w")],
    [value("distance", 1, 1, 1, 1)],
)
# The interface of MoGe-2, the picture's colours as points: dark pixels are outside of the mask, and the count of tokens is the scale
write(
    "points",
    [
        helper.make_node("Transpose", ["image"], ["points"], perm=[0, 2, 3, 1]),
        helper.make_node("Neg", ["points"], ["normal"]),
        helper.make_node("ReduceMax", ["image"], ["mask"], axes=[1], keepdims=0),
        helper.make_node("Cast", ["num_tokens"], ["tokens"], to=F),
        helper.make_node("Reshape", ["tokens", "one"], ["metric_scale"]),
    ],
    [value("image", 1, 3, "h", "w"), value("num_tokens", kind=TensorProto.INT64)],
    [value("points", 1, "h", "w", 3), value("normal", 1, "h", "w", 3), value("mask", 1, "h", "w"), value("metric_scale", 1)],
    [numpy_helper.from_array(np.array([1]), "one")],
)
# The interface of Depth Anything 3, its weights in a file of their own: twice the mean of a picture's channels, and 3 more
write(
    "views",
    [
        helper.make_node("ReduceMean", ["pixel_values"], ["mean"], axes=[2], keepdims=0),
        helper.make_node("Mul", ["mean", "gain"], ["confidence"]),
        helper.make_node("Add", ["confidence", "offset"], ["predicted_depth"]),
    ],
    [value("pixel_values", "batch", "views", 3, "h", "w")],
    [value("predicted_depth", "batch", "views", "h", "w"), value("confidence", "batch", "views", "h", "w")],
    [numpy_helper.from_array(np.array([v], np.float32), name) for name, v in (("gain", 2), ("offset", 3))],
    beside="views.onnx_data",
)
# A network of fixed size that normalises its input
write(
    "stem",
    [
        helper.make_node("Sub", ["image", "mean"], ["centred"]),
        helper.make_node("Conv", ["centred", "encoder.stem_half.conv.weight"], ["half"], "/encoder/stem_half/conv/Conv", kernel_shape=[1, 1]),
        helper.make_node("Relu", ["half"], ["depth"]),
    ],
    [value("image", 1, 3, 32, 64)],
    [value("depth", 1, 1, 32, 64)],
    [
        numpy_helper.from_array(np.full((1, 3, 1, 1), 0.25, np.float32), "mean"),
        numpy_helper.from_array(np.ones((1, 3, 1, 1), np.float32), "encoder.stem_half.conv.weight"),
    ],
)
