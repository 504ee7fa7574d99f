"""Model cards keep the origin of a network."""

import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import run_record

RUN = {"exported": {"checkpoint": "best.pt", "checkpoint_sha256": "ab" * 32}}


class Cards(unittest.TestCase):
    def run_main(self, folder, *words):
        with mock.patch.object(run_record, "MODELS", folder), mock.patch.object(sys, "argv", ["run_record.py", *words]):
            run_record.main()

    def test_a_known_origin_is_not_overwritten(self):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            model, card = folder / "net.onnx", folder / "net.md"
            model.write_bytes(b"one")
            # cards without an origin, and with an unknown one, may change
            for content in (b"one", b"two"):
                model.write_bytes(content)
                self.run_main(folder, "net")
                self.run_main(folder, "net", "--check")
                self.assertEqual(run_record.origin_in(card), run_record.about_run(None))
            run_record.into_card(card, run_record.block(model, RUN))
            before = card.read_text()
            model.write_bytes(b"three")
            with self.assertRaises(SystemExit) as raised:
                self.run_main(folder, "net")
            self.assertIn("net.md describes", str(raised.exception))
            self.assertEqual(card.read_text(), before)
            with self.assertRaises(SystemExit):
                self.run_main(folder, "net", "--check")


if __name__ == "__main__":
    unittest.main()
