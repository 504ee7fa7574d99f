"""Compares time and memory per photo of the embedded network and of Depth Anything V2 Small's architecture with all twelve layers.

    python cost.py ../target/release/tmpi photo.jpg [--runs 5]

Uses random weights (24.8 M, as many as published), so that nothing must be downloaded; time and memory do not depend on their values. Prints, for
`tmpi make` with alternating networks: median wall and CPU time, peak memory, and the size of the file. The embedded network runs as for photos, with the
mirrored photo too, and as for rooms, without it.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import warnings

import onnx
import torch
import transformers as t
from onnxruntime.transformers.float16 import convert_float_to_float16

from compare_adapters import Path, anything, enliven, export

LAYERS = 12


def files(folder):
    """The network in float32 and in float16."""
    torch.manual_seed(0)
    net, last = anything(384, 6, [48, 96, 192, 384], 64, "relative", LAYERS)
    x = torch.randn(1, 3, 518, 784)
    enliven(net, last, x)
    whole = f"{folder}/depth-anything-v2-whole.onnx"
    export(net, (x,), whole, True)
    half = f"{folder}/depth-anything-v2-half.onnx"
    onnx.save(convert_float_to_float16(onnx.load(whole), keep_io_types=True), half)
    return {"32 bits": whole, "16 bits": half}


# runs in a small process, because a program's peak memory includes that of its parent at the start
MEASURED = """
import os, sys, time
begun = time.time()
_, status, used = os.wait4(os.spawnvp(os.P_NOWAIT, sys.argv[1], sys.argv[1:]), 0)
print(status, time.time() - begun, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)
"""


def run(command):
    """Wall and CPU time in seconds, peak memory in MiB."""
    out = subprocess.run([sys.executable, "-c", MEASURED, *command], check=True, capture_output=True, text=True).stdout
    status, *figures = map(float, out.split())
    if status:
        raise SystemExit(f"{' '.join(command)} failed")
    return figures


def main():
    a = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    a.add_argument("program")
    a.add_argument("photo")
    a.add_argument("--runs", type=int, default=5)
    a = a.parse_args()
    warnings.filterwarnings("ignore")
    t.logging.set_verbosity_error()
    with tempfile.TemporaryDirectory() as folder:
        networks = {"photos": None, "rooms": None, **files(folder)}
        found = {name: [] for name in networks}
        for _ in range(a.runs):
            for name, file in networks.items():
                model = "tmpi" if file is None else f"depth-anything-v2={file}"
                options = ["--depth-model", model, *(["--flip=false"] if name == "rooms" else [])]
                found[name].append(run([a.program, "make", "--quiet", "--force", *options, "-o", f"{folder}/a.tmpi", a.photo]))
        print(f"{'network':10} {'MB':>6} {'wall s':>7} {'CPU s':>12} {'peak MiB':>9}")
        for name, file in networks.items():
            wall, processor, peak = (statistics.median(v) for v in zip(*found[name]))
            size = f"{Path(file).stat().st_size / 1e6:.1f}" if file else ""
            print(f"{name:10} {size:>6} {wall:7.2f} {processor:12.2f} {peak:9.0f}")


if __name__ == "__main__":
    main()
