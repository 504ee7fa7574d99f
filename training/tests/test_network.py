"""The depth network and its ONNX graph."""

import tempfile
import unittest
from pathlib import Path

import torch
from torch import nn

import export
import network
import onnx_graph


def trained():
    """A network with factors and statistics other than the initial ones."""
    torch.manual_seed(3)
    net = network.DepthNet()
    for m in net.modules():
        if isinstance(m, network.Conv):
            m.scale.uniform_(0.7, 1.3)
            m.bias.data.uniform_(-0.1, 0.1)
        if isinstance(m, nn.BatchNorm2d):
            m.running_mean.uniform_(-0.3, 0.3)
            m.running_var.uniform_(0.5, 2)
    return net.eval()


class Network(unittest.TestCase):
    def test_graph_and_module_agree(self):
        net = export.folded(trained())
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "x.onnx"
            g = onnx_graph.Graph("x")
            g.output(onnx_graph.depth(g, g.input("image", ["n", 3, "h", "w"]), net), "disparity", ["n", 1, "h", "w"])
            g.save(path, {})
            for n, h, w in ((1, 64, 96), (3, 96, 64)):
                self.assertLess(onnx_graph.check(path, network.Shipped(net), {"image": torch.randn(n, 3, h, w)}), 1e-4)

    def test_folding_changes_only_rounding(self):
        net, x = trained(), torch.randn(1, 3, 64, 96)
        with torch.no_grad():
            before = network.Shipped(net)(x)
            self.assertLess(float((network.Shipped(export.folded(net))(x) - before).abs().max()), 2e-2)

    def test_a_mirrored_picture_gives_a_mirrored_map(self):
        net, x = network.Shipped(trained(), mirrored=True), torch.randn(1, 3, 64, 96)
        with torch.no_grad():
            self.assertLess(float((net(x).flip(3) - net(x.flip(3))).abs().max()), 1e-4)

    def test_features_have_strides_2_to_32(self):
        encoder, x = trained().encoder, torch.randn(1, 3, 64, 96)
        shapes = [f.shape[1:] for f in encoder(x)]
        self.assertEqual(shapes, [(c, 64 >> i, 96 >> i) for i, c in enumerate(encoder.channels, 1)])

    def test_a_published_layer_equals_convolution_and_batchnorm(self):
        conv, norm = nn.Conv2d(4, 6, 3, padding=1, bias=False), nn.BatchNorm2d(6, eps=network.EPSILON).eval()
        norm.running_mean.uniform_(-1, 1)
        norm.running_var.uniform_(0.5, 2)
        state = {f"conv.{k}": v for k, v in conv.state_dict().items()} | {f"norm.{k}": v for k, v in norm.state_dict().items()}
        own, x = network.Conv(4, 6, 3), torch.randn(1, 4, 8, 8)
        own.take(state, "conv", "norm")
        with torch.no_grad():
            self.assertLess(float((own(x) - norm(conv(x))).abs().max()), 1e-5)

    def test_the_published_encoder_sets_all_weights(self):
        encoder = network.Encoder()
        for p in encoder.parameters():
            p.data.fill_(torch.nan)
        encoder.take_published()
        self.assertTrue(all(p.isfinite().all() for p in encoder.parameters()))


if __name__ == "__main__":
    unittest.main()
