"""What is done on a card that is lent for minutes, on a processor with a program that stands in for the renderer."""

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
import lent
import loop
import network
import pack
import sources
from tests.test_loop import packed

# writes a scene for each chunk of seeds
PROGRAM = """#!/bin/sh
mkdir -p "$3/$7" && cp "$(dirname "$0")"/scene/* "$3/$7"
"""


class Lent(unittest.TestCase):
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
        torch.save(loop.light(network.DepthNet(), 0, {}), root / "start.pt")
        for folder in ("scene", "assets/a"):
            (root / folder).mkdir(parents=True)
        (root / "assets" / "a" / "x.glb").write_bytes(b"model")
        cv2.imwrite(str(root / "scene" / "photo.png"), rng.integers(0, 256, (64, 96, 3), np.uint8))
        cv2.imwrite(str(root / "scene" / "disparity.png"), rng.integers(0, 65536, (64, 96)).astype(np.uint16))
        (root / "scene" / "scene.json").write_text('{"family": "room"}')
        # the program holds what travels anyway
        (root / "twice").write_bytes(b"#twice\n")
        (root / "program").write_bytes(PROGRAM.encode() + b"#twice\n#end\n")
        self.a = argparse.Namespace(
            carry=root / "carry", work=root / "work", out=root / "out", pack=root / "pictures.zip", init=root / "start.pt", program=root / "program",
            assets=root / "assets", device="cpu", renderers=2, batch=4, threads=1, seconds=0.1, minutes=1.0, of=None, every=2,
        )  # fmt: skip
        for module, name, value in ((lent, "TWICE", root / "twice"), (batches, "SHAPES", {(32, 64): 0.5, (64, 64): 0.5}), (depth, "LEAST", 3)):
            patched = mock.patch.object(module, name, value)
            patched.start()
            self.addCleanup(patched.stop)
        with mock.patch("builtins.print"):
            lent.packed(self.a)

    def test_the_program_arrives_whole(self):
        program, models = lent.unpacked(self.a)
        self.assertEqual(program.read_bytes(), (self.root / "program").read_bytes())
        self.assertNotIn(b"twice", lent.lzma.decompress((self.a.carry / "program.xz").read_bytes()))
        self.assertEqual((models / "x.glb").read_bytes(), b"model")
        (self.root / "twice").write_bytes(b"#other\n")
        program.unlink()
        with self.assertRaisesRegex(SystemExit, "not the one that was packed"):
            lent.unpacked(self.a)

    def test_what_is_too_large_is_refused(self):
        with mock.patch.object(lent, "MOST", 1000), mock.patch("builtins.print"), self.assertRaisesRegex(SystemExit, "too much to travel"):
            lent.packed(self.a)
        self.a.init = self.root / "none.pt"
        with self.assertRaisesRegex(SystemExit, "none.pt is not there"):
            lent.packed(self.a)

    def test_smoke_measures_with_scenes_of_the_renderers_and_steps_fit(self):
        program, _ = lent.unpacked(self.a)
        (program.parent / "scene").symlink_to(self.root / "scene")
        with mock.patch("builtins.print"):
            told = lent.smoked(self.a)
        self.assertEqual(json.loads((self.a.out / "smoke.json").read_text()), told)
        self.assertEqual(set(told["steps"]), {"32x64", "64x64"})
        self.assertTrue(0 < told["figures"]["score"] <= 1)
        # each shape half of the time
        self.assertAlmostEqual(told["step"], sum(0.5 / v for v in told["steps"].values()))
        told |= {"start": 10.0, "choice": 2.0, "step": 0.1}
        steps = lent.fitted(told, 9, 250)
        spent = told["start"] + told["choice"] + lent.SAVED + steps * (told["step"] + (told["choice"] + lent.SAVED) / 250)
        self.assertTrue(0.95 * 540 < spent <= 540)

    def test_only_what_may_come_back_is_brought(self):
        run = self.a.work / "run"
        run.mkdir(parents=True)
        for name, size in (("weights.pt", 10), ("last.pt", 10), ("last_weights.pt", 200)):
            (run / name).write_bytes(b"x" * size)
        with mock.patch.object(lent, "BACK", 100), mock.patch("builtins.print"):
            lent.bring(self.a)
        self.assertEqual([f.name for f in self.a.out.iterdir()], ["weights.pt"])


class Choices(unittest.TestCase):
    def test_figures_are_those_of_the_evaluation(self):
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
