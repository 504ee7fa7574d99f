"""Tests of the training scripts, without data: run `python -m unittest` in the parent folder."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
