"""Contents of training batches of the depth network."""

import math
import random
import tempfile
import unittest
import zipfile
from pathlib import Path

import cv2
import numpy as np
import torch

import augment
import batches
import common
import loop
import pack
import renderers
import sources
from tests.test_loop import packed

CPU = torch.device("cpu")


def filled(**shares):
    pictures = batches.Pictures(CPU)
    for p in packed():
        if not shares or p.group.split(":")[0] in shares or p.group in shares:
            pictures.add(p)
    return pictures


def one_picture(value, region=None):
    """A single picture whose colours equal its map."""
    value = np.float32(value)
    rgb = np.repeat((np.nan_to_num(value) * 255).astype(np.uint8)[..., None], 3, 2)
    pictures = batches.Pictures(CPU)
    none = np.zeros(value.shape, np.uint8)
    pictures.add(pack.Packed("x", "label", "disparity", False, rgb, value, none if region is None else region, np.uint8([0, 4, 1])))
    return pictures


class Batches(unittest.TestCase):
    def test_a_batch_depends_only_on_the_seed(self):
        digests = [loop.digest(vars(filled().batch(4, random.Random(s)))) for s in (1, 1, 2)]
        self.assertEqual(digests[0], digests[1])
        self.assertNotEqual(digests[0], digests[2])

    def test_groups_are_drawn_by_their_shares(self):
        pictures = filled(label=1, rgbd=1)
        drawn = [g for seed in range(40) for g, _ in pictures.batch(8, random.Random(seed)).of]
        want = batches.SHARES["label"] / (batches.SHARES["label"] + batches.SHARES["rgbd"])
        self.assertAlmostEqual(drawn.count("label") / len(drawn), want, delta=0.08)

    def test_two_labels_of_a_photograph_count_half_each(self):
        pictures = batches.Pictures(CPU)
        for name in ("a.b", "a", "c"):
            pictures.add(next(pack.Packed(**vars(p) | {"name": name}) for p in packed() if p.group == "label"))
        group = pictures.groups["label"]
        drawn = group.drawn(0, 4000, np.random.default_rng(1))[:, 0].tolist()
        for row, share in zip(group.rows, (0.25, 0.25, 0.5), strict=True):
            self.assertAlmostEqual(drawn.count(row[0]) / len(drawn), share, delta=0.04)

    def test_shapes_have_equal_pixels_and_their_probabilities(self):
        pictures, drawn = filled(), {}
        for seed in range(40):
            n, _, *shape = pictures.batch(4, random.Random(seed)).rgb.shape
            self.assertLess(abs(math.log(n * math.prod(shape) / (4 * min(h * w for h, w in batches.SHAPES)))), 0.3)
            drawn[tuple(shape)] = drawn.get(tuple(shape), 0) + 1
        self.assertLessEqual(set(drawn), set(batches.SHAPES))
        small = sum(v for (h, w), v in drawn.items() if h * w < 60_000)
        self.assertAlmostEqual(small / 40, sum(v for (h, w), v in batches.SHAPES.items() if h * w < 60_000), delta=0.2)

    def test_groups_and_spaces_of_a_batch_are_adjacent(self):
        batch = filled().batch(60, random.Random(1))
        for wanted in ("scene", "label", "rgbd", "pairs:depth", "pairs:order", "photo"):
            at = batch.where(lambda g, s: g == wanted)
            self.assertGreater(at.stop, at.start)
            self.assertEqual({g for g, _ in batch.of[at]}, {wanted})
        self.assertEqual(batch.where(lambda g, s: False), slice(0, 0))
        with self.assertRaisesRegex(ValueError, "not adjacent"):
            batch.where(lambda g, s: g in ("scene", "photo"))

    def test_pictures_are_drawn_in_similar_shapes(self):
        pictures = batches.Pictures(CPU)
        one = next(packed())
        for name, size in (("wide", (64, 128)), ("high", (128, 64))):
            rgb, none = np.zeros((*size, 3), np.uint8), np.zeros(size, np.uint8)
            pictures.add(pack.Packed(**vars(one) | {"name": name, "rgb": rgb, "value": np.float32(none), "region": none}))
        shape = list(batches.SHAPES).index((192, 384))
        drawn = pictures.groups[one.group].drawn(shape, 400, np.random.default_rng(1))
        self.assertGreater((drawn[:, 2] > drawn[:, 1]).mean(), 0.9)

    def test_the_store_keeps_its_contents_when_it_grows(self):
        few, many = batches.Store(CPU, room=16), batches.Store(CPU)
        for p in packed():
            self.assertEqual(few.add(p), many.add(p))
        self.assertTrue(torch.equal(few.pixels[: few.end], many.pixels[: many.end]))
        self.assertTrue(torch.equal(few.values[: few.end].view(torch.int16), many.values[: many.end].view(torch.int16)))

    def test_colours_map_and_regions_are_cropped_equally(self):
        ramp = np.tile(np.linspace(0, 1, 320), (240, 1))
        region = np.where(ramp > 0.5, 2, 1).astype(np.uint8)
        batch = one_picture(ramp, region).batch(8, random.Random(1))
        value, region = batch.value, batch.region
        small = torch.nn.functional.avg_pool2d(batch.rgb, 2)
        self.assertLess(float((small - value[:, None]).abs().max()), 0.02)
        sure = (value - 0.5).abs() > 0.03
        self.assertTrue(((value > 0.5) == (region == 2))[sure].all() and (batch.kind == torch.where(region == 2, 1, 4)).all())
        self.assertTrue((batch.good == 1).all())
        # some crops are mirrored
        rises = (value[:, :, -1] > value[:, :, 0]).all(1)
        self.assertTrue(rises.any() and not rises.all())

    def test_a_full_crop_at_original_size_equals_the_picture(self):
        rng = np.random.default_rng(1)
        value = cv2.GaussianBlur(rng.random((192, 256), np.float32), (0, 0), 4)
        pictures = one_picture((value - value.min()) / (value.max() - value.min()))
        rows = pictures.groups["label"]
        rows.prepare()
        whole = (np.zeros(1), np.zeros(1), np.full(1, 192.0), np.full(1, 256.0))
        rgb, value, *_ = pictures.cut(rows.table, (192, 256), whole)
        stored = pictures.store
        self.assertLess(float((rgb[0, 0] * 255 - (stored.pixels[: stored.end] & 255).view(192, 256)).abs().max()), 0.01)
        want = torch.nn.functional.avg_pool2d(stored.values[: stored.end].float().view(1, 192, 256), 2)
        self.assertLess(float((value - want).abs().max()), 1e-3)

    def test_crops_do_not_spread_unknown_pixels(self):
        value = np.tile(np.linspace(0, 1, 320), (240, 1))
        value[:, 160:] = np.nan
        batch = one_picture(value).batch(4, random.Random(1))
        dark = torch.nn.functional.avg_pool2d(batch.rgb, 2)[:, 0] < 0.01
        self.assertTrue((~dark).any() and batch.value[~dark].isfinite().float().mean() > 0.95)

    def test_a_crop_without_relief_does_not_count(self):
        self.assertEqual(float(one_picture(np.full((80, 96), 0.5)).batch(4, random.Random(1)).good.sum()), 0.0)

    def test_augmented_colours_stay_in_range(self):
        x, value = torch.rand(6, 3, 64, 96), torch.rand(6, 32, 48)
        one, same, other = (augment.photometric(x, value, random.Random(s)) for s in (1, 1, 2))
        self.assertTrue(torch.equal(one, same) and not torch.equal(one, other))
        self.assertTrue(0 <= float(one.min()) and float(one.max()) <= 1)

    def test_simulated_compression_matches_jpeg(self):
        grey = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 256, (64, 96), np.uint8), (0, 0), 1)
        x = torch.from_numpy(grey)[None, None].repeat(1, 3, 1, 1) / 255
        for quality in (40, 80):
            want = cv2.imdecode(cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_GRAYSCALE)
            got = augment.compressed(x, torch.full((1, 1, 1, 1), float(quality)))[0, 0].numpy() * 255
            self.assertLess(np.abs(got - want).mean(), 0.3 * np.abs(want.astype(float) - grey).mean())


class Packs(unittest.TestCase):
    def test_packed_pictures_are_read_back(self):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "pictures.zip"
            writer, written = pack.Writer(path), list(packed(each=1))
            for p in written:
                writer.add(p.name, p.group, p.space, sources.Sample(p.rgb, p.value, p.region, p.kinds[p.region]))
            # the last photograph again, with a label
            again = pack.Packed(**vars(written[1]) | {"name": "again", "rgb": written[-1].rgb})
            writer.add(again.name, again.group, again.space, sources.Sample(again.rgb, again.value, again.region, again.kinds[again.region]))
            writer.close()
            found = list(pack.opened(path))
            for a, b in zip([*written, again], found, strict=True):
                self.assertEqual((a.name, a.group, a.space, a.sparse), (b.name, b.group, b.space, b.sparse))
                value = a.value
                if a.group.split(":")[0] in pack.HALVED:
                    value = cv2.resize(common.shrink_map(value, (32, 48), 0.5), (96, 64), interpolation=cv2.INTER_NEAREST)
                np.testing.assert_allclose(value, b.value, atol=0.51 / (pack.STEPS - 1))
                np.testing.assert_array_equal(a.region, b.region)
                np.testing.assert_array_equal(a.kinds[a.region], b.kinds[b.region])
            np.testing.assert_array_equal(found[-1].rgb, found[-2].rgb)
            with zipfile.ZipFile(path) as z:
                self.assertEqual(sum(n.endswith(".webp") and ".map." not in n for n in z.namelist()), len(written))


# fake renderer: writes a scene for each seed
PROGRAM = """#!/bin/sh
mkdir -p "$3/$7" && cp "$(dirname "$0")"/scene/* "$3/$7"
"""


class Rendering(unittest.TestCase):
    def started(self, folder, text):
        program = Path(folder) / "program"
        program.write_text(text)
        program.chmod(0o755)
        scene = Path(folder) / "scene"
        scene.mkdir()
        cv2.imwrite(str(scene / "photo.png"), np.zeros((8, 8, 3), np.uint8))
        cv2.imwrite(str(scene / "disparity.png"), np.full((8, 8), 65535, np.uint16))
        (scene / "scene.json").write_text('{"family": "room"}')
        return renderers.Renderers(str(program), 2, Path(folder) / "out", renderers.FIRST, folder)

    def test_scenes_have_unique_seeds(self):
        with tempfile.TemporaryDirectory() as folder:
            renderers, found = self.started(folder, PROGRAM), []
            while len(found) < 6:
                found += renderers.taken(wait=True)
            renderers.close()
            self.assertEqual(len({s.name for s in found}), len(found))
            self.assertEqual((found[0].group, float(found[0].value.min())), ("scene:room", 1.0))

    def test_a_failing_renderer_ends_the_training(self):
        with tempfile.TemporaryDirectory() as folder:
            renderers = self.started(folder, "#!/bin/sh\necho no such option >&2\nexit 2\n")
            with self.assertRaisesRegex(RuntimeError, "no such option"):
                renderers.taken(wait=True)


if __name__ == "__main__":
    unittest.main()
