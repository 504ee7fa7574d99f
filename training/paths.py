"""Folders that the scripts here share; apart from `common`, so that a tool without a network to train needs no PyTorch."""

import os
from pathlib import Path

HERE = Path(__file__).resolve().parent
RUNS = HERE / "runs"
MODELS = HERE.parent / "models"
DATA = Path(os.environ.get("TMPI_DATA", HERE.parent.parent / "shared" / "data"))
