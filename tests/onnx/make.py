"""Writes the tiny networks that the tests run: python3 tests/onnx/make.py (needs the package onnx)."""

from pathlib import Path

from onnx import TensorProto, checker, helper, save

F = TensorProto.FLOAT
here = Path(__file__).parent


def write(name, nodes, inputs, outputs):
    graph = helper.make_graph(nodes, name, inputs, outputs)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8, producer_name="tmpi")
    checker.check_model(model)
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
