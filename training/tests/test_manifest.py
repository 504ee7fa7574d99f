"""Cards keep what they tell of a network."""

import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import manifest

RUN = {"exported": {"checkpoint": "best.pt", "checkpoint_sha256": "ab" * 32}}


class Cards(unittest.TestCase):
    def run_main(self, folder, *words):
        with mock.patch.object(manifest, "MODELS", folder), mock.patch.object(sys, "argv", ["manifest.py", *words]):
            manifest.main()

    def test_an_origin_that_is_told_is_kept(self):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            model, card = folder / "net.onnx", folder / "net.md"
            model.write_bytes(b"one")
            # a card without an origin, and one that says that there is none, are written
            for content in (b"one", b"two"):
                model.write_bytes(content)
                self.run_main(folder, "net")
                self.run_main(folder, "net", "--check")
                self.assertEqual(manifest.origin_in(card), manifest.about_run(None))
            manifest.into_card(card, manifest.block(model, RUN))
            before = card.read_text()
            model.write_bytes(b"three")
            with self.assertRaises(SystemExit) as refused:
                self.run_main(folder, "net")
            self.assertIn("net.md tells", str(refused.exception))
            self.assertEqual(card.read_text(), before)
            with self.assertRaises(SystemExit):
                self.run_main(folder, "net", "--check")


if __name__ == "__main__":
    unittest.main()
