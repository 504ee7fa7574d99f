"""Writes `goldens.json`: outputs of the shipped networks for a fixed input, by ONNX's own evaluator in NumPy instead of ONNX Runtime.

    pip install onnx && python tests/onnx/goldens.py

Run it after a network in `models` has changed. `crates/pipeline/tests/shipped_networks.rs` compares ONNX Runtime with it.
"""

import json
import pathlib

import numpy as np
import onnx
from onnx.reference import ReferenceEvaluator

HERE = pathlib.Path(__file__).parent
MODELS = HERE.parents[1] / "models"
# Each input is `low + (high - low) · ((3x + 5y + 7c) mod 32) / 32` in column x, row y and channel c of the whole batch, exact in f32.
INPUTS = {
    "depth.onnx": ([1, 3, 64, 96], -2, 2),
    "theta.onnx": ([2, 4, 32, 48], 0, 1),
    "psi.onnx": ([2, 9, 32, 32], 0, 1),
}
# Values of each output that are kept, evenly spaced.
KEPT = 64


def pattern(shape, low, high):
    n, c, h, w = shape
    channel, y, x = np.ogrid[: n * c, :h, :w]
    return (low + (high - low) * ((3 * x + 5 * y + 7 * channel) % 32) / 32).astype(np.float32).reshape(shape)


def golden(name):
    shape, low, high = INPUTS[name]
    network = ReferenceEvaluator(onnx.load(MODELS / name))
    outputs = network.run(None, {network.input_names[0]: pattern(shape, low, high)})
    values = [[float(f"{v:.6g}") for v in o.ravel()[:: o.size // KEPT][:KEPT]] for o in outputs]
    return {"network": name, "shape": shape, "low": low, "high": high, "outputs": values}


(HERE / "goldens.json").write_text(json.dumps([golden(name) for name in INPUTS], indent=1).replace("\n    ", " ") + "\n")
