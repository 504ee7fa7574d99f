"""Scores checkpoints on the training device, like `eval_depth.py --part wide` but without its other figures."""

import cv2
import numpy as np
import torch
import torch.nn.functional as F

import common
import eval_depth
import network

# pixels and mirroring for the two uses of the weights: rooms, and photos
USES = {"room": (eval_depth.AREA, False), "photo": (256 * 288, True)}


class Choice:
    """Scores a network on selection pictures.

    `sets` comes from `eval_depth.load_sets`. A figure is RMSE / deviation of the truth after the best affine map, which is √(1 − r²) for the
    correlation r. `score` is the mean over uses of the means over sets; figures of single sets are for the first use."""

    def __init__(self, sets, device, ramp=0.05):
        self.device, self.ramp, self.names, self.truths = device, ramp, [], []
        self.inputs = {use: {} for use in USES}  # by size: picture numbers, and pictures
        for name, pictures in sets.items():
            for rgb, d, valid in pictures:
                valid = valid & (d > 0)
                t = np.where(valid, d, 0) / d[valid].max()
                self.truths.append([torch.from_numpy(v.astype(np.float32)).to(device) for v in (t, valid)])
                for use, (area, _) in USES.items():
                    size = eval_depth.size_for(*rgb.shape[:2], area)
                    small = cv2.resize(rgb, size[::-1], interpolation=cv2.INTER_AREA if size[1] < rgb.shape[1] else cv2.INTER_LINEAR)
                    numbers, inputs = self.inputs[use].setdefault(size, ([], []))
                    numbers.append(len(self.names))
                    inputs.append(network.normal(common.chw(small).to(device)))
                self.names.append(name)

    @torch.no_grad()
    def __call__(self, net):
        """Figures of a network by name; empty without pictures."""
        net.eval()
        found = {}
        for use, (_, mirrored) in USES.items():
            shipped, figures = network.Shipped(net, mirrored, self.ramp), [None] * len(self.names)
            for at, pictures in self.inputs[use].values():
                for n, p in zip(at, shipped(torch.stack(pictures))):
                    figures[n] = self.figure(p[None], *self.truths[n])
            values = torch.stack(figures).tolist() if figures else []
            sets = {k: float(np.mean([v for v, name in zip(values, self.names) if name == k])) for k in dict.fromkeys(self.names)}
            found |= (sets if not found else {}) | ({use: float(np.mean(list(sets.values())))} if sets else {})
        return found | ({"score": float(np.mean([found[use] for use in USES]))} if found else {})

    def figure(self, p, t, valid):
        """Figure of a map [1, 1, h, w], resized to the truth."""
        p = F.interpolate(p, t.shape, mode="bilinear", align_corners=False)[0, 0].double()
        mean = lambda v: (v * valid).sum() / valid.sum()
        p, t = p - mean(p), t - mean(t.double())
        return (1 - mean(p * t) ** 2 / (mean(p * p) * mean(t * t)).clamp_min(1e-24)).clamp_min(0).sqrt()
