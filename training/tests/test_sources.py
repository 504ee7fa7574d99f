"""Reads only allowed training data, with the right meaning of maps."""

import json
import tempfile
import unittest
from pathlib import Path

import cv2
import numpy as np

import sources

INDEX = """path\tsource\tlicence\tkind\tunit\ttrain\torigin
rgbd/a/x.jpg\ts\tMIT\trgbd real: Kinect\tmm, 0 unknown\tyes\to
rgbd/a/y.jpg\ts\t?\trgbd real: Kinect\tmm, 0 unknown\tno (until its licence is known)\to
rgbd/a/l.jpg\ts\tMIT\trgbd real: LiDAR\tmm, sparse, 0 unknown\tyes\to
rgbd/b/z.jpg\ts\tMIT\trgbd real: phone\tdisp16: inverse depth, scale and offset unknown\tyes\to
stereo/c/d/\ts\tMIT\tstereo pair\tpx*256; 0 unknown\tyes\to
pairs/e/m.jpg\ts\tCC\tphoto + map\taffine-invariant DEPTH (linear, not disparity)\tyes\to
pairs/e/o.jpg\ts\tMIT\tphoto + map\tordering only, 8-bit\tyes\to
pairs/e/d.jpg\ts\tMIT\tphoto + map\tdisparity up to affine, float\tyes\to
assets/f.glb\ts\tMIT\tmodel\tmetres\tyes\to
"""


class Sources(unittest.TestCase):
    def setUp(self):
        made = tempfile.TemporaryDirectory()
        self.addCleanup(made.cleanup)
        self.root = Path(made.name)
        (self.root / "INDEX.tsv").write_text(INDEX)
        raw = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32)
        for name in ("rgbd/a/x.jpg", "rgbd/a/y.jpg", "rgbd/a/l.jpg", "rgbd/b/z.jpg", "stereo/c/d/left.jpg", "pairs/e/m.jpg", "pairs/e/o.jpg", "pairs/e/d.jpg"):
            path = self.root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), np.zeros((24, 32, 3), np.uint8))
            depth = "silver_disp_left" if "stereo" in name else f"{path.stem}_depth_mm" if "rgbd/a" in name else f"{path.stem}_disp16"
            cv2.imwrite(str(path.with_name(f"{depth}.png")), raw)
        self.items = {i.name.removeprefix("train2/"): i for i in sources.gathered(self.root)}

    def test_only_allowed_pictures_are_read(self):
        self.assertEqual(set(self.items), {"rgbd/a/x.jpg", "rgbd/a/l.jpg", "rgbd/b/z.jpg", "stereo/c/d", "pairs/e/m.jpg", "pairs/e/o.jpg", "pairs/e/d.jpg"})

    def test_excluded_pictures_are_never_trained_on(self):
        folder = self.root / "labels"
        folder.mkdir()
        photos = [f"train2/photos/{f}/{n}.jpg" for f in ("elementary", "imaginary", "other") for n in range(40)]
        for n, photo in enumerate(photos):
            (folder / f"{n:03}.json").write_text(json.dumps({"photo": photo}))
        (self.root / "INDEX.tsv").write_text(INDEX.split("\n")[0] + "".join(f"\n{p.removeprefix('train2/')}\ts\tper file\tphoto\t-\tyes\to" for p in photos))
        self.assertEqual({i.name for i in sources.gathered(self.root)}, {p for p in photos if "/other/" in p and not sources.held_out(p)})
        def read(held):
            return {photos[int(i.name.removeprefix("label/"))] for i in sources.labels(held, folder)}

        self.assertEqual(read(False), {p for p in photos if "/other/" in p and not sources.held_out(p)})
        # evaluation may use them
        self.assertEqual(read(True), {p for p in photos if sources.held_out(p)})
        for reason in sources.LEFT_OUT.values():
            self.assertIn("Unsplash", reason)

    def test_maps_have_the_right_space(self):
        spaces = {k: (i.group, i.space, i.sparse) for k, i in self.items.items()}
        self.assertEqual(spaces["pairs/e/m.jpg"], ("pairs:depth", "depth", False))
        self.assertEqual(spaces["pairs/e/o.jpg"], ("pairs:order", "order", False))
        self.assertEqual(spaces["pairs/e/d.jpg"], ("pairs:disparity", "disparity", False))
        self.assertEqual(spaces["rgbd/a/l.jpg"], ("rgbd", "disparity", True))

    def test_nearer_is_larger_and_unknown_is_nan(self):
        mm = sources.read_item(self.items["rgbd/a/x.jpg"]).value
        self.assertTrue(np.isnan(mm[0, 0]) and np.isnan(mm).sum() == 1)
        self.assertAlmostEqual(float(mm[10, 0] / mm[20, 0]), 2.0, places=5)
        inverse = sources.read_item(self.items["rgbd/b/z.jpg"]).value
        self.assertFalse(np.isnan(inverse).any())
        self.assertLess(inverse[3, 0], inverse[20, 0])
        pixels = sources.read_item(self.items["stereo/c/d"]).value
        self.assertTrue(np.isnan(pixels[0, 0]) and pixels[3, 0] < pixels[20, 0])

    def test_a_held_out_label_stays_held_out(self):
        held = [f"photos/{n}.jpg" for n in range(400) if sources.held_out(f"photos/{n}.jpg")]
        self.assertTrue(40 < len(held) < 120)
        train, kept = ({i.name for i in sources.labels(h)} for h in (False, True))
        self.assertFalse(train & kept)
        files = [json.loads(f.read_text())["photo"] for f in (sources.HERE / "labels").glob("*.json")]
        self.assertEqual(len(train | kept), len([p for p in files if sources.held_out(p) or not sources.is_left_out(p)]))


if __name__ == "__main__":
    unittest.main()
