"""The network of a map: the one to start from, trained on for some minutes with the log's lidar in that building."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml

from dsom_jax import checkpoint
from dsom_jax.atomic import write_atomic
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig
from dsom_jax.protocol.plan import Plan


def settings(start: Path, lidar: LidarConfig, changes: dict[str, Any]) -> dict[str, Any]:
    """Fields of ``TrainConfig`` for scans of ``lidar``, on top of the network in ``start``."""
    model = dict(checkpoint.load_provenance(start)["model"])
    view = min(lidar.fov, 2 * math.pi)
    reach = min(lidar.range_max, float(model["reach_min"]))
    model |= {"fov_min": view, "reach_min": reach}
    scan = {"fov_min": view, "fov_max": view, "reach_min": reach, "thinning": 2}
    given = {"model": model, "scan": scan}
    for name, value in changes.items():
        given[name] = given[name] | value if isinstance(value, dict) and name in given else value
    return given


def check_begun(folder: Path, made_of: dict[str, str]) -> None:
    """Note what a network is made of; UserError unless the one in ``folder``, if any, is of the same."""
    record = folder.with_suffix(".json")
    if folder.exists() and (json.loads(record.read_text()) if record.is_file() else None) != made_of:
        why = f"trained on another map, or from another network, or {record.name} beside it is lost"
        raise UserError(f"{folder}: {why}; delete it to train again")
    write_atomic(record, json.dumps(made_of).encode())


def adapt(plan: Plan, map_yaml: Path, map_digest: str, start: Path, lidar: LidarConfig, folder: Path) -> Path:
    """Folder of the network adapted to a map; a training that was killed goes on where it was."""
    if not plan.adapt_minutes > 0:
        return start
    check_begun(folder, {"map": map_digest, "start": checkpoint.digest(start)})
    config = folder.with_suffix(".yaml")
    write_atomic(config, yaml.safe_dump(settings(start, lidar, plan.adapt)).encode())
    length = ("--steps", plan.adapt_steps) if plan.adapt_steps else ("--minutes", plan.adapt_minutes)
    words = ["--maps", map_yaml, "--init", start, "--config", config, *length, "--out", folder, "--resume"]
    done = subprocess.run([sys.executable, "-m", "dsom_jax.train", *map(str, words)])
    if done.returncode:
        raise UserError(f"{folder}: training on {map_yaml.name} failed; its message is above")
    return folder
