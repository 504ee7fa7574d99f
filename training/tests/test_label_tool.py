"""Tests `label_tool.py` and `rasterise_labels.py` on synthetic pictures, and the label files."""

import hashlib
import json
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import label_tool as tool
import rasterise_labels
from rasterise_labels import LabelError, paint

W, H = 500, 400
# thousandths per pixel
UNIT = 1000 / W
CENTRE, RADIUS = (240.0, 190.0), 90.0


def texture(base, spread, seed, grain=1.5):
    noise = np.random.default_rng(seed).normal(0, 1, (H, W, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), grain)
    return np.clip(np.float32(base) + spread * noise / noise.std(), 0, 255)


def disc():
    """A textured disc with soft edges on a textured ground, and its mask."""
    y, x = np.mgrid[:H, :W]
    inside = RADIUS - np.hypot(x - CENTRE[0], y - CENTRE[1])
    cover = np.clip(inside + 0.5, 0, 1)[..., None]
    picture = cover * texture((90, 110, 160), 22, 1) + (1 - cover) * texture((120, 130, 90), 22, 2)
    return picture.astype(np.uint8), inside > 0


def rough(count=18, off=4.5):
    """A rough outline of the disc: a few points, off by up to `off` pixels, within `reach` including the chords."""
    rng = np.random.default_rng(5)
    turn = np.arange(count) / count * 2 * np.pi
    r = RADIUS + rng.uniform(-off, off, count)
    p = (np.c_[np.cos(turn), np.sin(turn)] * r[:, None] + CENTRE + 0.5) * UNIT
    return " ".join(f"{x:.0f},{y:.0f}" for x, y in p)


class Drawn(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.data = Path(folder.name)
        for place, name, value in ((rasterise_labels, "DATA", self.data), (rasterise_labels, "RUNS", self.data), (tool, "DATA", self.data), (tool, "LABELS", self.data)):
            change = mock.patch.object(place, name, value)
            change.start()
            self.addCleanup(change.stop)

    def label(self, regions, picture=None, **more):
        if picture is None:
            picture = texture((120, 130, 90), 15, 3).astype(np.uint8)
        path = self.data / "photo.png"
        cv2.imwrite(str(path), picture)
        return {"photo": "photo.png", "sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "size": [W, H], **more, "regions": regions}

    def faults(self, label):
        file = self.data / "one.json"
        file.write_text(json.dumps(label))
        return [what for level, what in tool.checked(file)[0] if level == "fault"]

    def test_outline_of_a_disc_is_found_within_two_pixels(self):
        picture, truth = disc()
        regions = [{"name": "wall", "kind": "wall", "area": "all", "metres": 5}, {"name": "disc", "kind": "object", "area": rough(), "metres": 2, "front": "wall"}]
        label = self.label(regions, picture)

        def worst(mask):
            edge = (mask.astype(np.uint8) - cv2.erode(mask.astype(np.uint8), np.ones((3, 3)))) > 0
            y, x = np.nonzero(edge)
            return np.abs(np.hypot(x - CENTRE[0], y - CENTRE[1]) - RADIUS).max()

        drawn = rasterise_labels.shape(regions[1], (W, H)) > 0
        found = paint(label)["region"] == 2
        self.assertGreater(worst(drawn), 4)
        self.assertLessEqual(worst(found), 2)
        self.assertEqual(self.faults(label), [])
        self.assertLess((found ^ truth).sum(), 0.02 * truth.sum())

    def test_a_partly_hidden_disc_is_found(self):
        # a bar of another colour hides a part of the disc's outline
        picture, truth = disc()
        picture[:, 200:260] = texture((40, 40, 220), 15, 4)[:, 200:260]
        bar = {"name": "bar", "kind": "object", "box": f"{200 * UNIT},0 {260 * UNIT},{H * UNIT}", "metres": 1}
        disc_ = {"name": "disc", "kind": "object", "area": rough(), "metres": 2}
        region = paint(self.label([{"name": "wall", "kind": "wall", "area": "all", "metres": 5}, disc_, bar], picture))["region"]
        seen = np.ones((H, W), bool)
        seen[:, 196:264] = False
        wrong = ((region == 2) ^ truth) & seen
        self.assertLess(wrong.sum(), 0.03 * (truth & seen).sum())
        self.assertTrue((region[:, 203:257] == 3).all())

    def test_reach_zero_keeps_the_outline(self):
        picture, _ = disc()
        part = {"name": "disc", "kind": "object", "area": rough(), "metres": 2, "reach": 0}
        region = paint(self.label([{"name": "wall", "kind": "wall", "area": "all", "metres": 5}, part], picture))["region"]
        np.testing.assert_array_equal(region == 2, rasterise_labels.shape(part, (W, H)) > 0)

    def test_planes_are_exact(self):
        y, x = (np.mgrid[:H, :W] + 0.5) * UNIT
        a, b, c = 2e-4, 5e-4, 0.1
        three = " ".join(f"{px},{py}:{1 / (a * px + b * py + c):.9f}" for px, py in ((0, 0), (1000, 0), (0, 800), (1000, 800)))
        found = paint(self.label([{"name": "wall", "kind": "wall", "area": "all", "metres": three}]))
        np.testing.assert_allclose(found["disparity"], a * x + b * y + c, rtol=1e-5)
        self.assertTrue(found["known"].all())
        # two points: a slope along their line, constant across it
        found = paint(self.label([{"name": "wall", "kind": "wall", "area": "all", "metres": "0,300:2 1000,300:4"}]))
        np.testing.assert_allclose(found["disparity"], 0.5 - 0.25 * x / 1000, rtol=1e-5)
        # three points in a line are like two
        found = paint(self.label([{"name": "wall", "kind": "wall", "area": "all", "metres": "0,301:2 500,299:2.6666667 1000,301:4"}]))
        np.testing.assert_allclose(found["disparity"], 0.5 - 0.25 * x / 1000, rtol=5e-3)

    def test_ground_with_a_horizon_and_a_post_on_it(self):
        y = (np.mgrid[:H, :W][0] + 0.5) * UNIT
        regions = [
            {"name": "sky", "kind": "sky", "area": "all"},
            {"name": "ground", "kind": "ground", "box": "0,320 1000,800", "metres": "500,700:2", "reach": 0},
            {"name": "post", "kind": "object", "box": "400,200 420,500", "foot": "410,500", "reach": 0, "front": "sky"},
        ]
        label = self.label(regions, horizon=300)
        found = paint(label)
        ground = found["region"] == 2
        np.testing.assert_allclose(found["disparity"][ground], (y[ground] - 300) / 400 / 2, rtol=1e-5)
        np.testing.assert_allclose(found["disparity"][found["region"] == 3], 0.25, rtol=1e-6)
        self.assertTrue((found["disparity"][found["region"] == 1] == 0).all())
        self.assertEqual(self.faults(label), [])
        regions[1]["metres"] = "500,250:2"
        with self.assertRaisesRegex(LabelError, "above the horizon"):
            paint(label)

    def test_bulge_brings_only_the_middle_nearer(self):
        ball = {"name": "ball", "kind": "object", "disc": "500,400 200,200", "metres": 2, "bulge": 0.2, "reach": 0}
        d = paint(self.label([{"name": "wall", "kind": "wall", "area": "all", "metres": 9}, ball]))["disparity"]
        self.assertAlmostEqual(1 / d[200, 250], 1.8, places=2)
        self.assertGreater(1 / d[200, 152], 1.9)

    def test_unknown_and_jumps_do_not_count(self):
        regions = [{"name": "wall", "kind": "wall", "area": "all", "metres": 9}, {"name": "post", "kind": "object", "box": "400,0 500,800", "metres": 1, "reach": 0}]
        regions.append({"name": "mirror", "kind": "unknown", "box": "700,100 900,300", "reach": 0})
        found = paint(self.label(regions))
        self.assertFalse(found["known"][100, 400])
        self.assertFalse(found["known"][200, 200])
        self.assertTrue(found["known"][200, 203] and found["known"][200, 190])
        self.assertEqual(found["kind"], ["", "wall", "object", "unknown"])

    def test_paints_at_another_size(self):
        picture, truth = disc()
        label = self.label([{"name": "sky", "kind": "sky", "area": "all"}, {"name": "disc", "kind": "object", "area": rough(), "metres": 2}], picture)
        found = paint(label, (250, 200))
        self.assertEqual([found[k].shape for k in ("disparity", "region", "known")], [(200, 250)] * 3)
        self.assertEqual([found[k].dtype for k in ("disparity", "region", "known")], [np.float32, np.int32, bool])
        self.assertLess(((found["region"] == 2) ^ truth[::2, ::2]).sum(), 0.04 * truth[::2, ::2].sum())

    def test_faults_are_reported(self):
        wall = {"name": "wall", "kind": "wall", "area": "all", "metres": 5}
        post = {"name": "post", "kind": "object", "box": "400,0 500,800", "metres": 1, "reach": 0, "front": "wall"}
        self.assertEqual(self.faults(self.label([wall, post])), [])
        self.assertIn("is not in front of wall", self.faults(self.label([wall, {**post, "metres": 7}]))[0])
        self.assertIn("not there", self.faults(self.label([wall, {**post, "front": "door"}]))[0])
        self.assertEqual(self.faults(self.label([wall, post, {"name": "cover", "kind": "wall", "area": "all", "metres": 3}])), ["wall: empty", "post: empty", "post: in front of wall, which is not there"])
        self.assertIn("in no region", self.faults(self.label([post]))[0])
        self.assertIn("kind 'thing'", self.faults(self.label([{**wall, "kind": "thing"}]))[0])
        self.assertIn("no field meters", self.faults(self.label([{**wall, "meters": 5}]))[0])
        self.assertIn("names", self.faults(self.label([wall, {**post, "name": "wall"}]))[0])
        self.assertIn("neither metres nor foot", self.faults(self.label([{k: v for k, v in wall.items() if k != "metres"}]))[0])
        self.assertIn("to stand on", self.faults(self.label([wall, {"name": "post", "kind": "object", "box": "400,0 500,800", "foot": "450,800"}]))[0])
        self.assertIn("not the photo", self.faults({**self.label([wall]), "sha256": "0" * 64})[0])
        dots = ";".join(f"{x},{y} {x + 8},{y} {x + 8},{y + 8} {x},{y + 8}" for x in range(20, 900, 60) for y in range(20, 700, 60))
        self.assertIn("speckled", self.faults(self.label([wall, {"name": "dots", "kind": "object", "area": dots, "metres": 2, "reach": 0}]))[0])

    def test_slits_and_specks_of_the_background_are_closed(self):
        left = {"name": "left", "kind": "wall", "box": "0,0 498,800", "metres": 3, "reach": 0}
        right = {"name": "right", "kind": "wall", "box": "502,0 1000,800", "metres": 4, "reach": 0}
        region = paint(self.label([{"name": "sky", "kind": "sky", "area": "all"}, left, right]))["region"]
        self.assertFalse((region == 1).any())
        # a wide gap remains
        region = paint(self.label([{"name": "sky", "kind": "sky", "area": "all"}, {**left, "box": "0,0 480,800"}, right]))["region"]
        self.assertTrue((region[:, 242:249] == 1).all())

    def test_old_files_in_pixels_are_painted(self):
        regions = [
            {"name": "sky", "outline": "all", "far": True},
            {"name": "wall", "outline": [[0, 200], [W, 200], [W, H], [0, H]], "metres": [[100, 300, 4]]},
            {"name": "hole", "outline": [[100, 250], [150, 250], [150, 300], [100, 300]], "unknown": True},
        ]
        label = {k: v for k, v in self.label(regions).items() if k != "sha256"}
        found = paint(label)
        self.assertEqual(found["kind"], ["", "sky", "object", "unknown"])
        self.assertEqual((found["disparity"][50, 50], found["disparity"][350, 50]), (0, 0.25))
        self.assertFalse(found["known"][275, 125])
        self.assertEqual(paint(label, (100, 80))["disparity"].shape, (80, 100))

    def test_put_and_view(self):
        cv2.imwrite(str(self.data / "photo.png"), disc()[0])
        words = '{"name": "wall", "kind": "wall", "area": "all", "metres": 5},\n{"name": "disc", "kind": "object", "disc": "481,381 180,180", "metres": 2}\n'
        with mock.patch.object(sys, "argv", ["label_tool.py", "-o", str(self.data), "put", "photo.png", "--horizon", "300"]), mock.patch("sys.stdin") as given:
            given.read.return_value = words
            tool.main()
        file = next(self.data.glob("*-photo.json"))
        self.assertEqual(tool.checked(file)[0], [])
        self.assertIsNotNone(cv2.imread(str(self.data / f"{file.stem}.paint.png")))
        with self.assertRaisesRegex(LabelError, "region 2"):
            tool.regions_of('{"name": "wall"}, {"name": }')


class Files(unittest.TestCase):
    def test_every_label_file_is_well_formed(self):
        files = sorted(tool.LABELS.glob("*.json"))
        self.assertTrue(files)
        for file in files:
            label = rasterise_labels.read(file)
            if not rasterise_labels.is_old(label):
                self.assertEqual(list(tool.format_errors(label)), [], file.name)
                for region, plane in zip(label["regions"], rasterise_labels.planes(label)):
                    self.assertTrue(rasterise_labels.shape(region, label["size"]).any(), f"{file.name}: {region['name']}")
                    self.assertTrue(np.isfinite(plane(np.float64(500), np.float64(900))), f"{file.name}: {region['name']}")


if __name__ == "__main__":
    unittest.main()
