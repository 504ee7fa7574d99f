"""No step of the depth training waits for the GPU; runs on fake tensors with shape and device but no values."""

import argparse
import traceback
import unittest
from unittest import mock

import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

import augment
import batches
import common
import depth
import loop
import losses
import network
from tests.test_loop import packed

CARD = torch.device("cuda:0")


class Transfers(TorchDispatchMode):
    """Records blocking copies between devices, and their stack traces."""

    def __init__(self):
        super().__init__()
        self.found = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        out = function(*args, **kwargs)
        tensors = [v for v in args if torch.is_tensor(v)]
        if function is torch.ops.aten._to_copy.default:
            waits = out.device != args[0].device and not kwargs.get("non_blocking")
        else:
            copy = function is torch.ops.aten.copy_.default
            waits = copy and tensors[0].device != tensors[1].device and not (args[2] if len(args) > 2 else kwargs.get("non_blocking"))
        if waits:
            self.found.append("".join(traceback.format_stack(limit=8)[:-1]))
        return out


def to_device(arrays, device):
    """`common.to_device` without pinned memory, which fake tensors do not support."""
    return [torch.from_numpy(a).to(device, non_blocking=True) for a in arrays]


class Waits(unittest.TestCase):
    def setUp(self):
        # other tests enable deterministic algorithms, which GPUs do not have for all operations
        was = torch.are_deterministic_algorithms_enabled()
        torch.use_deterministic_algorithms(False)
        self.addCleanup(torch.use_deterministic_algorithms, was)

    def found(self, loss_of):
        """Stack traces of waits in two steps; the first one may fill caches."""
        constant = lambda values, device: torch.zeros(torch.tensor(values).shape, device=device)
        changes = [mock.patch.object(m, "to_device", to_device) for m in (common, batches, augment, depth, network)]
        changes += [mock.patch.object(m, "constant", constant) for m in (common, augment, losses, network)]
        changes += [mock.patch.object(m, "generator", lambda seed, device: None) for m in (augment, depth)]
        changes += [mock.patch.object(batches, "SHAPES", {(32, 64): 0.5, (64, 32): 0.5})]
        changes += [mock.patch.object(depth, "loss_of", loss_of)]
        for change in changes:
            change.start()
            self.addCleanup(change.stop)
        with FakeTensorMode(allow_non_fake_inputs=True):
            pictures = batches.Pictures(CARD)
            for p in packed():
                pictures.add(p)
            with CARD:
                net, mean = network.DepthNet(0.2, 0.4), network.DepthNet()
            learner = loop.Learner(net, loop.Plan(steps=4, lr=1e-3, weight_decay=1e-2, ema=0.9, every=2, seed=1), mean)
            steps = depth.Steps(net, mean, pictures, argparse.Namespace(seed=1, batch=24, init="given"))

            def backward():
                # backward needs a GPU even for fake tensors; PyTorch's own does not wait
                for p in learner.params:
                    p.grad = torch.empty_like(p)

            for step in range(2):
                with Transfers() as transfers:
                    parts = steps.loss_at(step)
                    learner.learn(mock.Mock(backward=backward), step)
        self.assertEqual(set(parts), {"loss", *depth.WEIGHTS})
        return transfers.found

    def test_a_step_does_not_wait(self):
        self.assertEqual(self.found(depth.loss_of), [])

    def test_a_blocking_transfer_is_detected(self):
        true = depth.loss_of

        def waiting(p, *rest):
            return true(p + torch.tensor([1.0]).to(p.device), *rest)

        found = self.found(waiting)
        self.assertEqual(len(found), 1)
        self.assertIn("waiting", found[0])

    def test_reading_a_value_is_detected(self):
        true = depth.loss_of

        def waiting(p, *rest):
            return true(p * float(p.mean()), *rest)

        with self.assertRaisesRegex(Exception, "_local_scalar_dense"):
            self.found(waiting)


if __name__ == "__main__":
    unittest.main()
