"""A run that was stopped and went on ends with the same bits as one that was not."""

import contextlib
import io
import json
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

import cache
import depth
import loop
import manifest
import network
import psi
import sources
import theta

CHANNELS = (4, 6, 8, 10, 12)
GROUPS = ["scene:room", "label", "rgbd", "pairs:depth", "pairs:order"]
SPACES = ["disparity", "disparity", "disparity", "depth", "order"]


def small_cache(folder, seed=0, each=3):
    """A cache of made-up feature maps, of two shapes."""
    rng, records = np.random.default_rng(seed), {}
    for h, w in ((32, 64), (64, 32)):
        kept = [[f"{g}/{k}", g, s, k] for g, s in zip(GROUPS, SPACES) for k in range(each)]
        maps = cache.mapped(folder / cache.file_of((h, w)), cache.layout((h, w), CHANNELS), len(kept), True)
        for i in range(len(CHANNELS)):
            maps[f"f{i}"] = rng.normal(size=maps[f"f{i}"].shape)
            maps[f"s{i}"] = rng.random(maps[f"s{i}"].shape) + 0.1
        maps["value"] = np.where(rng.random(maps["value"].shape) < 0.1, np.nan, rng.random(maps["value"].shape))
        maps["region"][:, 2:8, 2:8] = 1
        maps["region"][:, 8:14, 8:14] = 2
        maps["kind"] = np.where(maps["region"] > 0, sources.THING, sources.SKY)
        maps.flush()
        records[f"{h}x{w}"] = kept
    bank = cache.mapped(folder / "statistics.bin", cache.statistics_layout(CHANNELS), 5, True)
    for i in range(len(CHANNELS)):
        bank[f"s{i}"] = rng.random(bank[f"s{i}"].shape) + 0.1
    bank.flush()
    (folder / "inputs.sha256").write_text("")
    manifest.write(folder / "cache.json", {"channels": CHANNELS, "records": records, "statistics": 5})


def depth_run(folder, out, steps=6, stop=None, seed=1, every=2):
    """The depth training on a small cache: the whole of it but the encoders."""
    records = depth.Records([folder], seed, 4)
    loop.seed_all(seed)
    net = network.Decoder(CHANNELS, (4, 6, 8, 10, 12), 0.2)

    def loss_at(step):
        features, own, value, region, kind, of = records.at(step)
        generator = torch.Generator().manual_seed(step)
        return depth.loss_of(net.half(depth.restyled(features, own, records.statistics()))[:, 0], value, region, kind, of, generator, depth.WEIGHTS)

    plan = loop.Plan(steps=steps, lr=1e-2, weight_decay=1e-2, ema=0.9, every=every, seed=seed)
    return loop.train(out, plan, net, loss_at, records.inputs(), {"batch": 4}, lambda mean: {"score": float(mean.head.weight.abs().sum())}, stop, quiet=True)


class Greedy(nn.Module):
    """A module that draws from every generator."""

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

    def test_depth_goes_on_to_the_same_bits(self):
        folder = self.root / "cache"
        folder.mkdir()
        small_cache(folder)
        whole = depth_run(folder, self.root / "whole")
        # a stop between two checkpoints, and one at a checkpoint
        for stop in (1, 3, 4):
            out = self.root / f"stopped{stop}"
            depth_run(folder, out, stop=stop)
            loop.seed_all(99)
            parts = depth_run(folder, out)
            self.assertEqual(loop.digest(parts), loop.digest(whole))
            self.assertEqual((out / "log.csv").read_text(), (self.root / "whole" / "log.csv").read_text())
            self.assertEqual(loop.digest(torch.load(out / "best.pt", weights_only=False)), loop.digest(torch.load(self.root / "whole" / "best.pt", weights_only=False)))
            self.assertEqual([s["step"] for s in manifest.read(out)["starts"]], [0, stop])
        self.assertEqual(manifest.read(out)["contents"], loop.digest(whole))
        other = depth_run(folder, self.root / "other", seed=2)
        self.assertNotEqual(loop.digest(other["live"]), loop.digest(whole["live"]))

    def test_a_killed_run_repeats_the_steps_after_its_checkpoint(self):
        folder = self.root / "cache"
        folder.mkdir()
        small_cache(folder)
        whole = depth_run(folder, self.root / "whole")
        true, calls = depth.loss_of, []

        def killed(*args):
            calls.append(None)
            if len(calls) == 4:
                raise KeyboardInterrupt
            return true(*args)

        with mock.patch.object(depth, "loss_of", killed), self.assertRaises(KeyboardInterrupt):
            depth_run(folder, self.root / "killed")
        self.assertEqual(loop.digest(depth_run(folder, self.root / "killed")), loop.digest(whole))

    def test_every_generator_is_stored(self):
        def run(out, stop=None):
            loop.seed_all(3)
            net, x = Greedy(), torch.ones(4, 3)
            plan = loop.Plan(steps=8, lr=1e-2, weight_decay=0, ema=0.9, every=4, seed=3)
            return loop.train(out, plan, net, lambda step: {"loss": (net(x) - step).square().mean()}, {}, stop=stop, quiet=True)

        whole = run(self.root / "a")
        run(self.root / "b", 5)
        self.assertEqual(loop.digest(run(self.root / "b")), loop.digest(whole))

    def test_theta_and_psi_go_on_to_the_same_bits(self):
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
                found.append(manifest.read(out)["contents"])
            self.assertEqual(found[0], found[1], module.__name__)

    def test_other_plans_and_other_files_are_refused(self):
        folder = self.root / "cache"
        folder.mkdir()
        small_cache(folder)
        depth_run(folder, self.root / "run", stop=2)
        with self.assertRaises(loop.Changed):
            depth_run(folder, self.root / "run", steps=8)
        small_cache(folder, seed=1)
        with self.assertRaisesRegex(loop.Changed, "cache"):
            depth_run(folder, self.root / "run")

    def test_a_batch_is_a_function_of_seed_and_step(self):
        folder = self.root / "cache"
        folder.mkdir()
        small_cache(folder)
        first, second = depth.Records([folder], 5, 4), depth.Records([folder], 5, 4)
        for step in (7, 3):
            second.at(step)
        self.assertEqual(loop.digest(first.at(3)), loop.digest(second.at(3)))
        self.assertNotEqual(loop.digest(first.at(3)), loop.digest(first.at(4)))
        self.assertNotEqual(loop.digest(first.at(3)), loop.digest(depth.Records([folder], 6, 4).at(3)))

    def test_shares_hold(self):
        folder = self.root / "cache"
        folder.mkdir()
        small_cache(folder)
        records = depth.Records([folder], 1, 16, {"scene": 0.5, "label": 0.5})
        drawn = [g for step in range(60) for g, _ in records.at(step)[-1]]
        self.assertEqual(set(drawn), {"scene", "label"})
        self.assertAlmostEqual(drawn.count("label") / len(drawn), 0.5, delta=0.06)


class Cards(unittest.TestCase):
    def test_cards_tell_the_shipped_files(self):
        for name in ("depth", "theta", "psi"):
            self.assertEqual(manifest.told_in(manifest.MODELS / f"{name}.md"), manifest.sha256(manifest.MODELS / f"{name}.onnx"), name)

    def test_a_card_keeps_what_is_written_by_hand(self):
        with tempfile.TemporaryDirectory() as t:
            card, model = Path(t) / "x.md", Path(t) / "x.onnx"
            model.write_bytes(b"first")
            card.write_text("# x\n\nby hand\n")
            manifest.into_card(card, manifest.block(model, [None]))
            model.write_bytes(b"second")
            manifest.into_card(card, manifest.block(model, [None]))
            text = card.read_text()
            self.assertEqual(manifest.told_in(card), manifest.sha256(model))
            self.assertEqual((text.count(manifest.BEGIN), text.count("by hand")), (1, 1))

    def test_command_lines_tell_no_folders_of_the_machine(self):
        words = ["--out=/elsewhere/runs/x", "/elsewhere/y.pt", str(manifest.DATA / "photos"), str(manifest.HERE / "runs"), "runs/z", "--lr=0.1"]
        self.assertEqual([manifest.plain(w) for w in words], ["--out=x", "y.pt", "$TMPI_DATA/photos", "runs", "runs/z", "--lr=0.1"])

    def test_a_manifest_follows_to_the_card(self):
        with tempfile.TemporaryDirectory() as t:
            root = Path(t)
            (root / "cache").mkdir()
            small_cache(root / "cache")
            depth_run(root / "cache", root / "run")
            model = root / "y.onnx"
            model.write_bytes(b"network")
            told = manifest.exported(root / "run" / "best.pt", model)
            text = "\n".join(manifest.block(model, [told, {"network": "f" * 64}]))
            for part in ("f" * 64, manifest.sha256(model), manifest.sha256(root / "run" / "best.pt")[:16], "6 steps, seed 1", "torch ", told["starts"][0]["commit"] or "commit"):
                self.assertIn(part, text)
            self.assertNotIn(t, text)
            self.assertEqual(json.loads((root / "run" / "manifest.json").read_text())["exported"]["file"], "y.onnx")


if __name__ == "__main__":
    unittest.main()
