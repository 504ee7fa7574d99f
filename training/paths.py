"""Folders that the scripts share; separate from `common`, so that tools without a network do not need PyTorch."""

import os
from pathlib import Path

HERE = Path(__file__).resolve().parent
RUNS = HERE / "runs"
MODELS = HERE.parent / "models"
DATA = Path(os.environ.get("TMPI_DATA", HERE.parent.parent / "shared" / "data"))
