"""Any localizer's trajectory held against a reference: ``python examples/judge_trajectory.py [ESTIMATE REFERENCE]``.

Both are TUM files (stamp x y z qx qy qz qw) in the map frame. Without arguments two are made up: an estimate that is
elsewhere for its first ten poses and then 0.1 m off.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import dsom_jax as dj


def judged(estimate: Path, reference: Path) -> dict[str, object]:
    """What ``summary.json`` of ``localize`` holds of one run: errors and rates, at the stamps of the estimate."""
    ours, theirs = dj.load_tum(estimate), dj.load_tum(reference)
    truth = dj.logs.associate(theirs, ours.stamps)  # (T, 3), interpolated; NaN where the reference has a gap
    return dj.summarize(dj.measure(ours.poses[None], truth))


def made_up(folder: Path) -> tuple[Path, Path]:
    """An estimate and a reference."""
    stamps = np.arange(40.0)
    truth = np.c_[0.3 * stamps, np.sin(stamps / 8), np.zeros(40)]
    off = np.where(stamps < 10, 5.0, 0.1)[:, None] * [1, 0, 0]
    files = folder / "estimate.tum", folder / "reference.tum"
    for file, poses in zip(files, (truth + off, truth), strict=True):
        dj.save_tum(file, stamps, poses)
    return files


if __name__ == "__main__":
    with TemporaryDirectory() as folder:
        files = [Path(word) for word in sys.argv[1:3]] if len(sys.argv) > 2 else made_up(Path(folder))
        found = judged(*files)
    for name in ("converged", "steps_median", "retention", "strict_success", "e_pos_m_median"):
        print(f"{name}: {found[name]}")
