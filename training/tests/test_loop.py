"""A resumed run ends with the same bits as an uninterrupted one."""

import argparse
import contextlib
import copy
import io
import json
import math
import random
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import torch
from torch import nn

import batches
import depth
import loop
import network
import pack
import psi
import run_record
import sources
import theta

GROUPS = ["scene:room", "label", "rgbd", "pairs:depth", "pairs:order", "photo"]
SPACES = ["disparity", "disparity", "disparity", "depth", "order", "none"]


def packed(seed=0, each=2):
    """Synthetic pictures of all groups."""
    rng = np.random.default_rng(seed)
    for group, space in zip(GROUPS, SPACES):
        for n in range(each):
            value = np.full((64, 96), np.nan, np.float32) if space == "none" else rng.random((64, 96), np.float32)
            region = np.zeros((64, 96), np.uint8)
            if group == "label":
                region[8:30, 8:40], region[30:60, 30:80] = 1, 2
            kinds = np.uint8([0, sources.THING, sources.SKY])
            yield pack.Packed(f"{group}/{n}", group, space, False, rng.integers(0, 256, (64, 96, 3), np.uint8), value, region, kinds)


def depth_run(file, out, steps=6, stop=None, seed=1, every=2):
    """Runs the depth training on small pictures; `file` contains their seed."""
    pictures = batches.Pictures(torch.device("cpu"))
    for p in packed(int(file.read_text())):
        pictures.add(p)
    loop.seed_all(seed)
    net = network.DepthNet(0.2, 0.4)
    mean = copy.deepcopy(net)
    depth_steps = depth.Steps(net, mean, pictures, argparse.Namespace(seed=seed, batch=4, init=None))
    plan = loop.Plan(steps=steps, lr=1e-3, weight_decay=1e-2, ema=0.9, every=every, seed=seed)
    score = lambda mean: {"score": float(mean.decoder.head.weight.abs().sum())}
    return loop.train(out, plan, net, depth_steps.loss_at, {"pack": [file]}, {"batch": 4}, score, stop, mean=mean, quiet=True, slow=list(net.encoder.parameters()), gain=0.5)


class RandomModule(nn.Module):
    """A module that uses every random generator."""

    def __init__(self):
        super().__init__()
        self.line, self.drop = nn.Linear(3, 1), nn.Dropout(0.5)

    def forward(self, x):
        return self.line(self.drop(x)) * random.random() + float(np.random.random()) + torch.rand(())


class Resume(unittest.TestCase):
    def setUp(self):
        made = tempfile.TemporaryDirectory()
        self.addCleanup(made.cleanup)
        self.root = Path(made.name)
        self.pack = self.root / "pack"
        self.pack.write_text("0")
        for module, name, value in ((batches, "SHAPES", {(32, 64): 0.5, (64, 32): 0.5}), (depth, "TEACHER_RAMP", (0, 4))):
            patched = mock.patch.object(module, name, value)
            patched.start()
            self.addCleanup(patched.stop)

    def test_depth_resumes_to_the_same_bits(self):
        whole = depth_run(self.pack, self.root / "whole")
        # stop between checkpoints, and at a checkpoint
        for stop in (1, 3, 4):
            out = self.root / f"stopped{stop}"
            depth_run(self.pack, out, stop=stop)
            loop.seed_all(99)
            parts = depth_run(self.pack, out)
            self.assertEqual(loop.digest(parts), loop.digest(whole))
            self.assertEqual((out / "log.csv").read_text(), (self.root / "whole" / "log.csv").read_text())
            self.assertEqual(loop.digest(torch.load(out / "best.pt", weights_only=False)), loop.digest(torch.load(self.root / "whole" / "best.pt", weights_only=False)))
            self.assertEqual([s["step"] for s in run_record.read(out)["starts"]], [0, stop])
        self.assertEqual(run_record.read(out)["contents"], loop.digest(whole))
        other = depth_run(self.pack, self.root / "other", seed=2)
        self.assertNotEqual(loop.digest(other["live"]), loop.digest(whole["live"]))

    def test_a_killed_run_repeats_the_steps_after_its_checkpoint(self):
        whole = depth_run(self.pack, self.root / "whole")
        true, calls = depth.loss_of, []

        def killed(*args):
            calls.append(None)
            if len(calls) == 4:
                raise KeyboardInterrupt
            return true(*args)

        with mock.patch.object(depth, "loss_of", killed), self.assertRaises(KeyboardInterrupt):
            depth_run(self.pack, self.root / "killed")
        self.assertEqual(loop.digest(depth_run(self.pack, self.root / "killed")), loop.digest(whole))

    def test_every_random_generator_is_saved(self):
        def run(out, stop=None):
            loop.seed_all(3)
            net, x = RandomModule(), torch.ones(4, 3)
            plan = loop.Plan(steps=8, lr=1e-2, weight_decay=0, ema=0.9, every=4, seed=3)
            return loop.train(out, plan, net, lambda step: {"loss": (net(x) - step).square().mean()}, {}, stop=stop, quiet=True)

        whole = run(self.root / "a")
        run(self.root / "b", 5)
        self.assertEqual(loop.digest(run(self.root / "b")), loop.digest(whole))

    def test_theta_and_psi_resume_to_the_same_bits(self):
        rng = np.random.default_rng(0)
        for n in range(3):
            f = self.root / "scenes" / str(n)
            f.mkdir(parents=True)
            cv2.imwrite(str(f / "photo.png"), rng.integers(0, 256, (200, 200, 3), np.uint8))
            cv2.imwrite(str(f / "disparity.png"), cv2.resize(rng.integers(0, 65536, (5, 5)).astype(np.uint16), (200, 200)))
            np.save(f / "layers.npy", rng.integers(0, 256, (4, 13, 64, 64), np.uint8))
            (f / "scene.json").write_text("{}")
        scenes = str(self.root / "scenes")
        commands = {theta: ["--batch", "1"], psi: ["--held", scenes, "--batch", "2"]}
        for module, options in commands.items():
            found = []
            for name, stops in (("whole", [None]), ("parts", ["2", None])):
                out = self.root / module.__name__ / name
                for stop in stops:
                    line = ["x", "--scenes", scenes, "--out", str(out), "--steps", "4", "--every", "3", *options, *(["--stop", stop] if stop else [])]
                    with mock.patch.object(sys, "argv", line), contextlib.redirect_stdout(io.StringIO()):
                        module.main()
                found.append(run_record.read(out)["contents"])
            self.assertEqual(found[0], found[1], module.__name__)

    def test_changed_plans_and_files_are_rejected(self):
        depth_run(self.pack, self.root / "run", stop=2)
        with self.assertRaises(loop.Changed):
            depth_run(self.pack, self.root / "run", steps=8)
        self.pack.write_text("1")
        with self.assertRaisesRegex(loop.Changed, "pack"):
            depth_run(self.pack, self.root / "run")

    def test_a_step_without_a_finite_gradient_is_skipped(self):
        net = nn.Linear(2, 1)
        before = copy.deepcopy(net.state_dict())
        factor = lambda step: torch.tensor(1.0 if step == 2 else math.nan)
        plan = loop.Plan(steps=2, lr=1e-2, weight_decay=0, ema=0.9, every=2, seed=1)
        state = loop.train(self.root / "nan", plan, net, lambda step: {"loss": net(torch.ones(1, 2)).sum() * factor(step)}, {}, quiet=True)
        self.assertEqual(state["rows"][0]["left out"], 1.0)
        self.assertEqual(loop.digest(state["live"]), loop.digest(before))

    def test_minutes_stop_a_run_that_can_resume(self):
        whole = depth_run(self.pack, self.root / "whole", steps=2, every=1)
        with mock.patch.object(loop.time, "time", iter(range(0, 10**6, 100)).__next__):
            net = nn.Linear(2, 1)
            plan = loop.Plan(steps=9, lr=1e-2, weight_decay=0, ema=0.9, every=1, seed=1)
            state = loop.train(self.root / "short", plan, net, lambda step: {"loss": net(torch.ones(1, 2)).square().sum()}, {}, minutes=3, quiet=True)
        self.assertTrue(1 <= state["step"] < 9)
        self.assertEqual(loop.reached(self.root / "short"), state["step"])
        self.assertEqual(whole["step"], 2)


class Cards(unittest.TestCase):
    def test_cards_have_the_digests_of_the_shipped_files(self):
        for name in ("depth", "theta", "psi"):
            self.assertEqual(run_record.digest_in(run_record.MODELS / f"{name}.md"), run_record.sha256(run_record.MODELS / f"{name}.onnx"), name)

    def test_a_card_keeps_hand_written_text(self):
        with tempfile.TemporaryDirectory() as t:
            card, model = Path(t) / "x.md", Path(t) / "x.onnx"
            model.write_bytes(b"first")
            card.write_text("# x\n\nby hand\n")
            run_record.into_card(card, run_record.block(model, None))
            model.write_bytes(b"second")
            run_record.into_card(card, run_record.block(model, None))
            text = card.read_text()
            self.assertEqual(run_record.digest_in(card), run_record.sha256(model))
            self.assertEqual((text.count(run_record.BEGIN), text.count("by hand")), (1, 1))

    def test_command_lines_contain_no_local_folders(self):
        words = ["--out=/elsewhere/runs/x", "/elsewhere/y.pt", str(run_record.DATA / "photos"), str(run_record.HERE / "runs"), "runs/z", "--lr=0.1"]
        self.assertEqual([run_record.plain(w) for w in words], ["--out=x", "y.pt", "$TMPI_DATA/photos", "runs", "runs/z", "--lr=0.1"])

    def test_a_card_describes_the_run_of_the_manifest(self):
        with tempfile.TemporaryDirectory() as t:
            root = Path(t)
            net, plan = nn.Linear(2, 1), loop.Plan(steps=6, lr=1e-2, weight_decay=0, ema=0.9, every=3, seed=1)
            loss_at = lambda step: {"loss": net(torch.ones(1, 2)).square().sum()}
            loop.train(root / "run", plan, net, loss_at, {}, measure=lambda mean: {"score": 1.0}, quiet=True)
            model = root / "y.onnx"
            model.write_bytes(b"network")
            record = run_record.exported(root / "run" / "best.pt", model)
            text = "\n".join(run_record.block(model, record))
            for part in (run_record.sha256(model), run_record.sha256(root / "run" / "best.pt")[:16], "6 steps, seed 1", "torch ", record["starts"][0]["commit"] or "commit"):
                self.assertIn(part, text)
            self.assertNotIn(t, text)
            self.assertEqual(json.loads((root / "run" / "manifest.json").read_text())["exported"]["file"], "y.onnx")


if __name__ == "__main__":
    unittest.main()
