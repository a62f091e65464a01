"""What a training run goes on from: its own folder, if that is the run asked for, or the network of another."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from dsom_jax import checkpoint
from dsom_jax.atomic import write_atomic
from dsom_jax.errors import UserError
from dsom_jax.run_folder import Run

_R = TypeVar("_R", bound=Run)


def reopen(
    kind: type[_R], path: Path, read_config: Callable[[Any], Any], maps: tuple[Path, ...], steps: int | None
) -> _R:
    """The run that the ``run.json`` at ``path`` describes; ``read_config`` makes its configuration of what it holds.

    UserError if it is another than ``maps`` and ``steps``, where given, ask for; ``steps`` are those of a run that was
    stopped before it had counted its own.
    """
    record = checkpoint.read_record(path, "restore it, or give another --out")
    run = kind(path.parent, None, *_checked(record, path))
    run.config = read_config(record["config"])
    if maps and tuple(map(str, maps)) != run.maps:
        raise UserError(f"--maps: the run in {path} has {', '.join(run.maps) or 'none'}; resume without --maps")
    run.hold()
    if steps is not None and run.total is not None and steps != run.total:
        raise UserError(f"--steps {steps}: the run in {path} has {run.total}; resume without --steps")
    run.total = run.total or steps
    return run


def _checked(record: Any, path: Path) -> tuple[tuple[str, ...], int | None, float, str | None]:
    """Maps, steps, seconds and ``init`` of a run.json; UserError for a field that is missing or of another kind."""

    def fits(name: str, *kinds: type) -> Any:
        if not isinstance(record, dict) or name not in record:
            raise UserError(f"{path}: no run to resume here (field {name} is missing); give another --out")
        value = record[name]
        if not isinstance(value, kinds) or isinstance(value, bool):
            raise UserError(f"{path}: field {name}: is {str(value)[:40]}; restore the file, or give another --out")
        return value

    maps, total, seconds = fits("maps", list), fits("total", int, type(None)), fits("seconds", int, float)
    fits("config", dict)
    if not all(isinstance(name, str) for name in maps):
        raise UserError(f"{path}: field maps: holds no names of files; restore the file, or give another --out")
    if (total is not None and total < 1) or not 0 <= seconds < float("inf"):
        raise UserError(f"{path}: field total or seconds: out of range; restore the file, or give another --out")
    init = record.get("init")
    return tuple(maps), total, float(seconds), init if isinstance(init, str) else None


def check_init(init: Path | None, run: Run, path: Path) -> None:
    """UserError for another ``--init`` than the run's, or none where it is still needed; says if it is not read."""
    if init is not None and init.name != run.init:
        raise UserError(f"--init {init}: the run in {path} began with {run.init or 'fresh weights'}; resume without it")
    if init is None and run.init is not None and not run.states():
        raise UserError(f"{path}: the run begins with {run.init} and has saved no state yet; give --init, too")
    if init is not None and run.states():
        print(f"--init {init}: not read, the run goes on from {run.states()[-1]}")


def load_init(path: Path | None, wanted: Any, kind: str = "dsom") -> Any:
    """The network to start from, if one is named; it must be of the run's configuration ``wanted``."""
    if path is None:
        return None
    model = checkpoint.load(path, kind=kind)
    own, run = flat(asdict(model.config)), flat(asdict(wanted))
    unlike = ", ".join(f"{name} = {own[name]!r}, the run's is {run[name]!r}" for name in own if own[name] != run[name])
    if unlike:
        raise UserError(f"{path}: field model: {unlike}; give a --config with the network's own, or another --init")
    return model


def flat(fields: dict[str, Any]) -> dict[str, Any]:
    """Fields of a network's configuration by name, without the scans it was trained for: they are no part of it."""
    inner = {name: value for part in fields.values() if isinstance(part, dict) for name, value in part.items()}
    outer = {name: value for name, value in fields.items() if not isinstance(value, dict)}
    return {name: value for name, value in (outer | inner).items() if name not in ("fov_min", "reach_min")}


def trim_log(path: Path, step: int) -> list[str]:
    """The lines of the log up to ``step``, to which the file is cut; says how many are damaged and left out."""
    lines = path.read_bytes().decode(errors="replace").splitlines() if path.exists() else []
    numbers = [step_of(line) for line in lines]
    intact = [line for line, number in zip(lines, numbers, strict=True) if number is not None and number <= step]
    # The last line is half there if its process was killed; any other has suffered something else.
    if lost := sum(number is None for number in numbers[:-1]):
        print(f"{path}: {lost} damaged lines, left out")
    write_atomic(path, "".join(line + "\n" for line in intact).encode())
    return intact


def step_of(line: str) -> int | None:
    """The step that a line of the log is about, None if it is damaged."""
    try:
        step = json.loads(line)["step"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return step if isinstance(step, int) else None
