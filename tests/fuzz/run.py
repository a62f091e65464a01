"""Mutated files and command lines against every loader: ``python tests/fuzz/run.py --count 20000``.

An input is well if it loads, or ends in a ``UserError`` of one printable line of at most 400 characters, within 10
seconds and a gigabyte, with nothing written and nothing said on stdout or stderr. Every input follows from its number:
``--first N --count 1`` repeats input N.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import numpy as np  # noqa: E402

from dsom_jax.errors import LONGEST, UserError  # noqa: E402
from fuzz import seeds  # noqa: E402
from fuzz.mutate import mutate  # noqa: E402

SECONDS, PATIENCE, GIGABYTE = 10, 100, 1_000_000
"""Limits of one input: seconds of the processor, and of the clock on a busy machine; memory in kB."""


class Hang(BaseException):
    """Not an Exception: no reader may catch it."""


class Bench:
    """A folder of good files in which one input after the other is laid out and read."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        seeds.make(folder)
        self.good = {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
        self.outcomes: Counter[str] = Counter()
        self.faults: list[dict[str, Any]] = []
        self.slowest = 0.0

    def check_seeds(self) -> None:
        """Every seed loads as it is; the words of one command are not those of the others."""
        for target in seeds.TARGETS:
            if target.name != "other words":
                target.load(self.folder)

    def try_input(self, number: int) -> None:
        """Lay out input ``number``, read it, judge, and put the good files back."""
        rng = np.random.default_rng([7, number])
        target = seeds.TARGETS[number % len(seeds.TARGETS)]
        names = rng.permutation(target.files)[: 1 + int(rng.random() < 0.2)].tolist()
        for name in names:
            path = self.folder / name
            path.write_bytes(mutate(rng, self.good[path]))
        start, before = time.process_time(), peak()
        fault, said = self.read(target)
        taken = time.process_time() - start
        self.slowest = max(self.slowest, taken)
        if not fault and taken > SECONDS:
            fault = f"took {taken:.1f} s"
        if not fault and peak() - before > GIGABYTE:
            fault = f"took {(peak() - before) / 1e6:.2f} GB"
        left = self.restore(names)
        if not fault and left:
            fault = f"wrote {left}"
        self.outcomes["fault" if fault else "refused" if said else "loaded"] += 1
        if fault:
            self.faults.append({"input": number, "target": target.name, "files": names, "fault": fault})

    def read(self, target: seeds.Target) -> tuple[str, str]:
        """What was wrong, and the line that was said; both empty where the input loads in silence."""
        signal.setitimer(signal.ITIMER_REAL, PATIENCE)
        try:
            with captured(self.folder) as output:
                try:
                    target.load(self.folder)
                    said = ""
                except UserError as error:
                    said = str(error)
        except Hang:
            return f"did not end in {PATIENCE} s: {where()}", ""
        except BaseException as error:
            return f"{type(error).__name__}: {str(error)[:200]} {where(error)}", ""
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        if said and (len(said) > LONGEST or not said.isprintable()):
            return f"said {said!r}", said
        return (f"chatter {output[0][:200]!r}" if output[0] else ""), said

    def restore(self, names: list[str]) -> list[str]:
        """Put the good files back; returns what was written beside or over them."""
        for name in names:
            (self.folder / name).write_bytes(self.good[self.folder / name])
        now = {path for path in self.folder.rglob("*") if path.is_file()}
        left = [str(path.relative_to(self.folder)) for path in now - self.good.keys()]
        left += [path.name for path, content in self.good.items() if path.stat().st_size != len(content)]
        for path in now - self.good.keys():
            path.unlink()
        return left


def peak() -> int:
    """Most memory that this process ever held, kB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def where(error: BaseException | None = None) -> str:
    """Last place inside of the package."""
    frames = traceback.extract_tb(error.__traceback__ if error else sys.exc_info()[2])
    own = [f"{Path(f.filename).name}:{f.lineno}" for f in frames if "dsom_jax" in f.filename]
    return f"at {own[-1]}" if own else ""


@contextmanager
def captured(folder: Path) -> Iterator[list[str]]:
    """What is written to file descriptors 1 and 2 meanwhile, by whatever library."""
    output = [""]
    with tempfile.TemporaryFile() as file:
        kept = os.dup(1), os.dup(2)
        sys.stdout.flush(), sys.stderr.flush()
        os.dup2(file.fileno(), 1), os.dup2(file.fileno(), 2)
        try:
            yield output
        finally:
            sys.stdout.flush(), sys.stderr.flush()
            for number, old in enumerate(kept, start=1):
                os.dup2(old, number)
                os.close(old)
            file.seek(0)
            output[0] = file.read(2000).decode(errors="replace")


def fuzz(inputs: range, log: Path | None = None) -> Bench:
    """Try the inputs; faults are also appended to ``log``."""

    def stop(*_: Any) -> None:
        raise Hang

    signal.signal(signal.SIGALRM, stop)
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    try:
        bench = Bench(folder)
        bench.check_seeds()
        for number in inputs:
            known = len(bench.faults)
            bench.try_input(number)
            for fault in bench.faults[known:]:
                if log:
                    with log.open("a") as file:
                        file.write(json.dumps(fault) + "\n")
        return bench
    finally:
        shutil.rmtree(folder)


def main() -> None:
    """Command line."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--count", type=int, default=2000)
    options.add_argument("--first", type=int, default=0)
    options.add_argument("--log", type=Path)
    args = options.parse_args()
    start = time.perf_counter()
    bench = fuzz(range(args.first, args.first + args.count), args.log)
    for fault in bench.faults:
        print(json.dumps(fault))
    kinds = Counter(f"{f['target']}: {f['fault'][:100]}" for f in bench.faults)
    print("\n".join(f"{count} x {kind}" for kind, count in kinds.most_common()))
    print(
        f"{args.count} inputs in {time.perf_counter() - start:.0f} s: {dict(bench.outcomes)}; "
        f"slowest {bench.slowest:.2f} s, peak {peak() / 1e6:.2f} GB"
    )
    raise SystemExit(bool(bench.faults))


if __name__ == "__main__":
    main()
