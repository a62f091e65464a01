"""Deliberate faults: does any test notice? ``python tests/mutation/run.py [--only TEXT] [--jobs 2]``; not part of CI.

Each fault of ``faults.py`` is put into a copy of the tree, and the tests named beside it are run there until the first
failure. A fault that no test notices survives, and is listed. Exit code 1 if fewer than 95 % are killed.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue

import tyro
from faults import FAULTS, Fault

ROOT = Path(__file__).resolve().parents[2]
PARTS = ("src", "tests", "docs", "checkpoints", "pyproject.toml", "README.md")
WANTED = 0.95
NOTHING_RUN = 5
"""Exit code of pytest where no test was chosen."""


def main(only: str = "", jobs: int = 1, timeout: float = 900.0) -> None:
    """Run the faults whose file, text or tests contain ``only``, ``jobs`` at a time, ``timeout`` seconds for each."""
    chosen = [fault for fault in FAULTS if only in " ".join(fault)]
    with tempfile.TemporaryDirectory() as folder:
        copies: Queue[Path] = Queue()
        for number in range(jobs):
            copies.put(copy(Path(folder) / str(number)))

        def one(fault: Fault) -> bool:
            tree = copies.get()
            try:
                return killed(fault, tree, timeout)
            finally:
                copies.put(tree)

        with ThreadPoolExecutor(jobs) as pool:
            found = list(pool.map(one, chosen))
    survivors = [fault for fault, dead in zip(chosen, found, strict=True) if not dead]
    for fault in survivors:
        print(f"survives: {fault.file}: {fault.old!r} -> {fault.new!r} ({fault.tests} -k {fault.only!r})")
    print(f"{sum(found)} of {len(found)} killed")
    sys.exit(0 if sum(found) >= WANTED * len(found) else 1)


def copy(tree: Path) -> Path:
    """The parts of the repository that tests need."""
    tree.mkdir()
    for part in PARTS:
        source = ROOT / part
        if source.is_dir():
            shutil.copytree(source, tree / part, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, tree / part)
    return tree


def killed(fault: Fault, tree: Path, timeout: float) -> bool:
    """Whether a test fails with the fault in the tree; the tree is as it was afterwards."""
    path = tree / "src" / "dsom_jax" / fault.file
    sound = path.read_text()
    if sound.count(fault.old) != 1:
        raise SystemExit(f"{fault.file}: {fault.old!r} stands there {sound.count(fault.old)} times, not once")
    path.write_text(sound.replace(fault.old, fault.new))
    words = [sys.executable, "-m", "pytest", "-n", "0", "-x", "-q", "-p", "no:cacheprovider"]
    words += [f"tests/{name}" for name in fault.tests.split()] + (["-k", fault.only] if fault.only else [])
    try:
        done = subprocess.run(
            words, cwd=tree, env=os.environ | {"PYTHONPATH": str(tree / "src")}, capture_output=True, timeout=timeout
        )
    except subprocess.TimeoutExpired:  # a fault that never ends is seen, too
        return True
    finally:
        path.write_text(sound)
    if done.returncode == NOTHING_RUN:
        raise SystemExit(f"{fault.tests} -k {fault.only!r}: no such test")
    print("killed  " if done.returncode else "SURVIVES", fault.file, repr(fault.old)[:70], flush=True)
    return done.returncode != 0


if __name__ == "__main__":
    tyro.cli(main)
