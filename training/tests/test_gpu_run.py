"""Tests `gpu_run.py` on a CPU with a fake renderer."""

import argparse
import json
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import torch

import batches
import choose
import depth
import eval_depth
import gpu_run
import loop
import network
import pack
import sources
from tests.test_loop import packed

# writes a scene for each chunk of seeds
PROGRAM = """#!/bin/sh
mkdir -p "$3/$7" && cp "$(dirname "$0")"/scene/* "$3/$7"
"""


class GpuRun(unittest.TestCase):
    def setUp(self):
        made = tempfile.TemporaryDirectory()
        self.addCleanup(made.cleanup)
        self.root = root = Path(made.name)
        writer = pack.Writer(root / "pictures.zip")
        for p in packed(each=1):
            writer.add(p.name, p.group, p.space, sources.Sample(p.rgb, p.value, p.region, p.kinds[p.region]))
        rng = np.random.default_rng(1)
        none = np.zeros((96, 128), np.uint8)
        writer.add("set/0", "choice:set", "disparity", sources.Sample(rng.integers(0, 256, (96, 128, 3), np.uint8), rng.random((96, 128), np.float32), none, none))
        writer.close()
        torch.manual_seed(1)
        torch.save(loop.compact_weights(network.DepthNet(), 0, {}), root / "start.pt")
        for folder in ("scene", "assets/a"):
            (root / folder).mkdir(parents=True)
        (root / "assets" / "a" / "x.glb").write_bytes(b"model")
        cv2.imwrite(str(root / "scene" / "photo.png"), rng.integers(0, 256, (64, 96, 3), np.uint8))
        cv2.imwrite(str(root / "scene" / "disparity.png"), rng.integers(0, 65536, (64, 96)).astype(np.uint16))
        (root / "scene" / "scene.json").write_text('{"family": "room"}')
        # the program embeds a file that the repository contains
        (root / "twice").write_bytes(b"#twice\n")
        (root / "program").write_bytes(PROGRAM.encode() + b"#twice\n#end\n")
        self.a = argparse.Namespace(
            carry=root / "carry", work=root / "work", out=root / "out", pack=root / "pictures.zip", init=root / "start.pt", program=root / "program",
            assets=root / "assets", device="cpu", renderers=2, batch=4, threads=1, seconds=0.1, minutes=1.0, of=None, every=2,
        )  # fmt: skip
        for module, name, value in ((gpu_run, "EMBEDDED", root / "twice"), (batches, "SHAPES", {(32, 64): 0.5, (64, 64): 0.5}), (depth, "MIN_SCENES", 3)):
            patched = mock.patch.object(module, name, value)
            patched.start()
            self.addCleanup(patched.stop)
        with mock.patch("builtins.print"):
            gpu_run.pack_files(self.a)

    def test_the_program_is_restored_exactly(self):
        program, models = gpu_run.unpack_files(self.a)
        self.assertEqual(program.read_bytes(), (self.root / "program").read_bytes())
        self.assertNotIn(b"twice", gpu_run.lzma.decompress((self.a.carry / "program.xz").read_bytes()))
        self.assertEqual((models / "x.glb").read_bytes(), b"model")
        (self.root / "twice").write_bytes(b"#other\n")
        program.unlink()
        with self.assertRaisesRegex(SystemExit, "differs from the packed one"):
            gpu_run.unpack_files(self.a)

    def test_too_large_uploads_are_rejected(self):
        with mock.patch.object(gpu_run, "MAX_UPLOAD", 1000), mock.patch("builtins.print"), self.assertRaisesRegex(SystemExit, "too large"):
            gpu_run.pack_files(self.a)
        self.a.init = self.root / "none.pt"
        with self.assertRaisesRegex(SystemExit, "none.pt does not exist"):
            gpu_run.pack_files(self.a)

    def test_smoke_measures_speed_and_the_steps_that_fit(self):
        program, _ = gpu_run.unpack_files(self.a)
        (program.parent / "scene").symlink_to(self.root / "scene")
        with mock.patch("builtins.print"):
            measured = gpu_run.smoke(self.a)
        self.assertEqual(json.loads((self.a.out / "smoke.json").read_text()), measured)
        self.assertEqual(set(measured["steps"]), {"32x64", "64x64"})
        self.assertTrue(0 < measured["figures"]["score"] <= 1)
        # each shape has probability 0.5
        self.assertAlmostEqual(measured["step"], sum(0.5 / v for v in measured["steps"].values()))
        measured |= {"start": 10.0, "choice": 2.0, "step": 0.1}
        steps = gpu_run.steps_that_fit(measured, 9, 250)
        spent = measured["start"] + measured["choice"] + gpu_run.SAVE_SECONDS + steps * (measured["step"] + (measured["choice"] + gpu_run.SAVE_SECONDS) / 250)
        self.assertTrue(0.95 * 540 < spent <= 540)

    def test_only_allowed_files_are_returned(self):
        run = self.a.work / "run"
        run.mkdir(parents=True)
        for name, size in (("weights.pt", 10), ("last.pt", 10), ("last_weights.pt", 200)):
            (run / name).write_bytes(b"x" * size)
        with mock.patch.object(gpu_run, "MAX_RESULT", 100), mock.patch("builtins.print"):
            gpu_run.bring(self.a)
        self.assertEqual([f.name for f in self.a.out.iterdir()], ["weights.pt"])


class Choices(unittest.TestCase):
    def test_figures_match_the_evaluation(self):
        rng = np.random.default_rng(2)
        torch.manual_seed(2)
        sets = {}
        for name, size in (("a", (96, 128)), ("a", (120, 90)), ("b", (96, 128))):
            d = cv2.GaussianBlur(rng.random(size), (0, 0), 5)
            sets.setdefault(name, []).append((rng.integers(0, 256, (*size, 3), np.uint8), d, rng.random(size) > 0.2))
        net = network.DepthNet().eval()
        found = choose.Choice(sets, torch.device("cpu"))(net)
        means = []
        for use, (area, mirrored) in choose.USES.items():
            want = {k: v["net"] for k, v in eval_depth.evaluate(network.Shipped(net, mirrored, 0.05), sets, area=area).items()}
            means.append(float(np.mean(list(want.values()))))
            self.assertAlmostEqual(found[use], means[-1], delta=2e-3)
            if use == "room":
                for k, v in want.items():
                    self.assertAlmostEqual(found[k], v, delta=2e-3)
        self.assertAlmostEqual(found["score"], float(np.mean(means)), delta=2e-3)


if __name__ == "__main__":
    unittest.main()
