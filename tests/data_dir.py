"""Where the real logs and maps are; tests that need them skip where they are absent."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(os.environ.get("DSOM_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")


def real_data(name: str) -> Path:
    """Path of a real log or map, ``name`` relative to the data folder; skips the test without it."""
    path = ROOT / name
    if not path.exists():
        pytest.skip(f"real data {name} is absent; set DSOM_DATA to the folder that holds it")
    return path
