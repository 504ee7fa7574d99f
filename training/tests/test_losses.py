"""Properties of losses and measures."""

import unittest

import cv2
import numpy as np
import torch

import losses
import thing_metrics
from sources import SKY, SURFACE, THING, Sample


def scene(h=48, w=64):
    """A map with sky, ground that comes nearer to the bottom, and two things in front: target [1, H, W], region, kind."""
    y = np.linspace(0, 1, h)[:, None] * np.ones((1, w))
    t, region = np.where(y > 0.4, 0.5 * (y - 0.4), 0), np.where(y > 0.4, 2, 1)
    for i, (x, near) in enumerate(((8, 0.6), (40, 0.9))):
        t[12:40, x : x + 16], region[12:40, x : x + 16] = near, 3 + i
    kind = np.array([0, SKY, SURFACE, THING, THING])[region]
    return torch.tensor(t[None], dtype=torch.float32), torch.tensor(region[None]), torch.tensor(kind[None])


NONE, SOME = [0.0], [0.1]


def noise(shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


class Losses(unittest.TestCase):
    def test_scale_and_shift_do_not_matter(self):
        t, region, kind = scene()
        p = t + 0.1 * noise(t.shape)
        generator = lambda: torch.Generator().manual_seed(1)
        for of in (
            lambda p: losses.disparity(p, t, SOME), lambda p: losses.depth(p, t, SOME), lambda p: [losses.order(p, t, generator())],
            lambda p: losses.things(p, t, region, kind), lambda p: [losses.sky(p, kind)],
        ):  # fmt: skip
            for a, b in zip(of(p), of(7 * p - 3)):
                torch.testing.assert_close(a, b, rtol=2e-3, atol=2e-4)

    def test_the_truth_scores_best_and_its_inverse_worst(self):
        t, region, kind = scene()
        for of in (
            lambda p: losses.disparity(p, t, NONE)[0], lambda p: losses.disparity(p, t, NONE)[1], lambda p: losses.order(p, t, torch.Generator().manual_seed(1)),
            lambda p: losses.things(p, t, region, kind)[0], lambda p: losses.sky(p, kind),
        ):  # fmt: skip
            right, spoilt, turned = (float(of(p)) for p in (t, t + 0.1 * noise(t.shape), -t))
            self.assertLess(right, spoilt)
            self.assertLess(spoilt, turned)

    def test_unknown_pixels_do_not_matter(self):
        t, region, kind = scene()
        p, hole = t + 0.1 * noise(t.shape), noise(t.shape, 5) > 1
        t = t.masked_fill(hole, torch.nan)
        for of in (losses.disparity, losses.depth):
            whole = p.clone().requires_grad_()
            sum(v.sum() for v in of(whole, t, SOME)).backward()
            self.assertTrue(torch.isfinite(whole.grad).all())
            self.assertEqual(float(whole.grad[hole].abs().max()), 0.0)
            self.assertGreater(float(whole.grad[~hole].abs().max()), 0.0)
        self.assertTrue(all(torch.isfinite(v).all() for v in losses.things(p, t, region, kind)))

    def test_nothing_known_gives_no_loss(self):
        t, region, kind = scene()
        p = noise(t.shape).requires_grad_()
        nothing = torch.full_like(t, torch.nan)
        total = sum(v.sum() for v in (*losses.disparity(p, nothing, SOME), *losses.depth(p, nothing, SOME), *losses.things(p, nothing, region, kind)))
        total.backward()
        self.assertTrue(torch.isfinite(total) and torch.isfinite(p.grad).all())

    def test_affine_depth_is_fitted_as_depth(self):
        z = torch.linspace(1, 12, 64).repeat(1, 48, 1)
        t = 1 - (z - 1) / 11
        right = 1 / z
        self.assertLess(float(losses.depth(right, t, NONE)[0]), 0.25 * float(losses.disparity(right, t, NONE)[0]))
        self.assertLess(float(losses.depth(right, t, NONE)[0]), 0.25 * float(losses.depth(-right.sqrt(), t, NONE)[0]))

    def test_outliers_hardly_change_the_fit(self):
        t = noise((1, 40, 40))
        p = 2 * t + 1
        p[0, :4] += 50
        known = torch.ones_like(t, dtype=torch.bool)
        scale, shift = losses.fit(p, t, known, rounds=8)
        self.assertLess(float((scale * p + shift - t)[0, 4:].abs().max()), 0.05)
        self.assertGreaterEqual(float(losses.fit(-t, t, known)[0]), 0.5)

    def test_an_inconsistent_thing_scores_worse(self):
        t, region, kind = scene()
        broken = t.clone()
        broken[0, 12:40, 8:24] += 0.3 * torch.linspace(-1, 1, 28)[:, None].sign()
        whole = float(losses.things(t, t, region, kind)[1])
        self.assertLess(whole, 0.05)
        self.assertGreater(float(losses.things(broken, t, region, kind)[1]), whole + 0.02)

    def test_descent_finds_the_truth_from_noise(self):
        t, region, kind = scene()
        p = noise(t.shape, 3).requires_grad_()
        optimiser = torch.optim.Adam([p], 0.05)
        for _ in range(300):
            loss = sum(v.sum() for v in (*losses.disparity(p, t, NONE), *losses.things(p, t, region, kind), losses.sky(p, kind)))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        self.assertGreater(float(torch.corrcoef(torch.stack([p.detach().flatten(), t.flatten()]))[0, 1]), 0.98)

    def test_descent_finds_the_order_of_depth_from_noise(self):
        z = 1 + 11 * torch.rand((1, 6, 8), generator=torch.Generator().manual_seed(2)).repeat_interleave(6, 1).repeat_interleave(6, 2)
        p = noise(z.shape, 4).requires_grad_()
        optimiser = torch.optim.Adam([p], 0.05)
        for _ in range(400):
            loss = sum(v.sum() for v in losses.depth(p, 1 - z / 12, NONE))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        ranks = torch.stack([v.flatten().argsort().argsort().float() for v in (p.detach(), -z)])
        self.assertGreater(float(torch.corrcoef(ranks)[0, 1]), 0.95)


class Things(unittest.TestCase):
    def sample(self):
        t, region, kind = (v[0].numpy() for v in scene(192, 256))
        return Sample(np.zeros((192, 256, 3), np.uint8), t.astype(np.float32), region.astype(np.uint8), kind.astype(np.uint8))

    def sized(self):
        t, region, kind = scene(192, 256)
        return t[0].numpy().astype(float), self.sample()

    def test_the_label_itself_scores_perfectly(self):
        t, sample = self.sized()
        found = thing_metrics.measure(3 * t + 2, sample)
        self.assertEqual(found["order"], 1.0)
        self.assertLess(found["whole"], 1e-6)

    def test_a_border_may_be_off_by_at_most_two_pixels(self):
        t, sample = self.sized()
        found = [thing_metrics.measure(np.roll(t, n, 1), sample)["border"] for n in range(-4, 5)]
        # borders along rows are not moved and stay right
        level = found[4] - found[0]
        self.assertEqual(found[4], 1.0)
        self.assertGreater(min(found[2:7]), 1 - 0.1 * level)
        self.assertLess(max(*found[:2], *found[7:]), 1 - 0.8 * level)
        self.assertEqual(thing_metrics.measure(-t, sample).get("border"), 0.0)
        # the steepness does not matter
        self.assertGreater(thing_metrics.measure(cv2.GaussianBlur(t, (0, 0), 2), sample)["border"], 0.9)

    def test_thin_things_have_their_own_figure(self):
        t, sample = self.sized()
        sample.region[60:150, 128:132], sample.kind[60:150, 128:132], sample.lines = 9, THING, (9,)
        missed = t.copy()
        sample.value[60:150, 128:132] = t[60:150, 128:132] = 1.0
        # labels are unknown at outlines
        sample.value[60:150, [127, 128, 131, 132]] = np.nan
        self.assertNotIn("thin", thing_metrics.measure(t, self.sample()))
        for off, least, most in ((0, 0.99, 1), (2, 0.9, 1), (8, 0, 0.2)):
            p = missed.copy()
            p[60:150, 128 + off : 132 + off] = 1.0
            thin = thing_metrics.measure(p, sample)["thin"]
            self.assertTrue(least <= thin <= most, (off, thin))
        self.assertLess(thing_metrics.measure(missed, sample)["thin"], 0.05)

    def test_the_inverse_map_has_the_wrong_order(self):
        t, sample = self.sized()
        self.assertEqual(thing_metrics.measure(-t, sample)["order"], 0.0)

    def test_a_flat_map_is_half_right(self):
        t, sample = self.sized()
        self.assertEqual(thing_metrics.measure(0 * t + 1, sample)["order"], 0.5)

    def test_noise_makes_things_inconsistent(self):
        t, sample = self.sized()
        random = np.random.default_rng(0).normal(size=t.shape)
        figures = [thing_metrics.measure(t + s * random, sample)["whole"] for s in (0.01, 0.1)]
        self.assertGreater(figures[1], 3 * figures[0])


if __name__ == "__main__":
    unittest.main()
