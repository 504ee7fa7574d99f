"""The graph of several decoders gives what PyTorch does."""

import tempfile
import unittest
from pathlib import Path

import torch
from torch import nn

import export
import graph
import network

# of the feature maps, the classifier's
FIRST = network.MobileNetV2.CHANNELS
WIDTH = (4, 6, 8, 10, 12)


class Made(nn.Module):
    """Feature maps by pooling and one mixing matrix a level, in place of the encoders."""

    def __init__(self, channels):
        super().__init__()
        self.channels = channels
        self.mix = nn.ModuleList(nn.Conv2d(3, c, 1) for c in channels)

    def forward(self, x):
        return [m(nn.functional.avg_pool2d(x, 2 << i)) for i, m in enumerate(self.mix)]

    def written(self, g, x):
        size = lambda i: {"kernel_shape": [2 << i] * 2, "strides": [2 << i] * 2}
        return [g.layer(g.op("AveragePool", x, **size(i)), m) for i, m in enumerate(self.mix)]


class Net(nn.Module):
    """A network with a decoder whose statistics are not those that it began with."""

    def __init__(self, channels, encoder):
        super().__init__()
        self.encoder, self.decoder = encoder, network.Decoder(channels, WIDTH)
        for m in self.decoder.modules():
            if isinstance(m, nn.BatchNorm2d):
                m.running_mean.uniform_(-0.3, 0.3)
                m.running_var.uniform_(0.5, 2)


def written(net, path, about=None):
    """`net` as `export.depth` writes it."""
    g = graph.Graph("x", half=False)
    x = g.input("image", ["n", 3, "h", "w"])
    both = g.op("Concat", x, graph.mirrored(g, x), axis=0) if net.mirrored else x
    p = graph.mean(g, net.encoder.written(g, both), net.decoders, net.mirrored, FIRST)
    g.output(graph.unit(g, p), "disparity", ["n", 1, "h", "w"])
    g.save(path, about or {})


class Several(unittest.TestCase):
    def setUp(self):
        torch.manual_seed(3)
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.path = Path(folder.name) / "x.onnx"
        wide = (*FIRST[:2], FIRST[2] + 4, FIRST[3] + 4, FIRST[4] + 4)
        encoder = Made(wide)
        self.nets = [Net(wide, encoder), Net(FIRST, encoder), Net(wide, encoder)]

    def test_graph_and_module_agree(self):
        for mirrored in (False, True):
            net = network.Mean(self.nets, mirrored).eval()
            written(net, self.path)
            for n, h, w in ((1, 64, 96), (3, 96, 64)):
                worst = graph.check(self.path, network.Shipped(net), {"image": torch.randn(n, 3, h, w)})
                self.assertLess(worst, 1e-4)

    def test_it_is_the_mean_of_what_each_says(self):
        x = torch.randn(2, 3, 64, 96)
        with torch.no_grad():
            each = [network.unit(n.decoder.half(n.decoder.seen(n.encoder(x)))) for n in (m.eval() for m in self.nets)]
            want = nn.functional.interpolate(sum(each), scale_factor=2, mode="bilinear", align_corners=False)
            self.assertLess(float((network.Mean(self.nets).eval()(x) - want).abs().max()), 1e-5)

    def test_a_mirrored_picture_gives_the_mirrored_map(self):
        net, x = network.Mean(self.nets, True).eval(), torch.randn(1, 3, 64, 96)
        with torch.no_grad():
            self.assertLess(float((net(x).flip(3) - net(x.flip(3))).abs().max()), 1e-4)
            self.assertGreater(float((network.Mean(self.nets).eval()(x).flip(3) - network.Mean(self.nets).eval()(x.flip(3))).abs().max()), 1e-2)

    def test_a_decoder_is_taken_from_a_file(self):
        net = network.Mean(self.nets[:1]).eval()
        export.fold_into_half(net)
        written(net, self.path)
        other = network.Decoder(self.nets[0].encoder.channels, WIDTH)
        other.take(self.path)
        x = self.nets[0].encoder(torch.randn(1, 3, 64, 96))
        with torch.no_grad():
            self.assertLess(float((other.eval().half(x) - net.decoders[0].half(x)).abs().max()), 1e-4)

    def test_all_decoders_are_taken_from_a_file(self):
        net = network.Mean(self.nets).eval()
        export.fold_into_half(net)
        written(net, self.path, {"decoders": "3"})
        self.assertEqual(network.decoders(self.path), 3)
        features = self.nets[0].encoder(torch.randn(1, 3, 64, 96))
        with torch.no_grad():
            for nth, of in zip(range(-3, 0), net.decoders):
                other = network.Decoder(self.nets[0].encoder.channels if of.both() else FIRST, WIDTH)
                other.take(self.path, nth=nth)
                self.assertLess(float((other.eval().half(of.seen(features)) - of.half(of.seen(features))).abs().max()), 1e-4)


if __name__ == "__main__":
    unittest.main()
