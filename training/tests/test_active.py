"""What the voices disagree on."""

import unittest

import numpy as np
import torch
from torch import nn

import active


class Says(nn.Module):
    """A network that says brightness, with a bump of its own in the left half."""

    def __init__(self, bump):
        super().__init__()
        self.bump = bump

    def forward(self, x):
        p = x.mean(1, keepdim=True).clone()
        p[..., : p.shape[-1] // 2] += self.bump
        return p


class Disagreement(unittest.TestCase):
    def setUp(self):
        g = np.random.default_rng(1)
        self.rgb = np.uint8(g.integers(0, 255, (96, 128, 3)))

    def test_who_says_the_same_disagrees_nowhere(self):
        maps = active.heard([Says(0.0), Says(0.0)], self.rgb)
        self.assertEqual(maps.shape, (4, 96, 128))
        self.assertLess(float(active.disagreement(maps).max()), 1e-4)

    def test_who_goes_by_the_side_disagrees_with_its_mirror_image(self):
        one = active.disagreement(active.heard([Says(0.0), Says(0.0)], self.rgb)).mean()
        other = active.disagreement(active.heard([Says(5.0)], self.rgb)).mean()
        self.assertGreater(other, one + 0.3)

    def test_no_label_that_is_held_out_is_asked_for(self):
        for photo in active.unlabelled():
            self.assertFalse(active.sources.held_out(str(photo.relative_to(active.DATA))))


if __name__ == "__main__":
    unittest.main()
