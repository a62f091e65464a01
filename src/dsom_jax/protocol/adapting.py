"""The networks of a map: those to start from, trained on for a while with the log's lidar in that building."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from dsom_jax import checkpoint
from dsom_jax.atomic import write_atomic
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig
from dsom_jax.protocol.plan import ProtocolPlan, merged


def settings(start: Path, lidar: LidarConfig, changes: dict[str, Any]) -> dict[str, Any]:
    """Fields of ``TrainConfig`` for scans of ``lidar``, on top of the network in ``start``."""
    model = dict(checkpoint.load_provenance(start)["model"])
    view = min(lidar.fov, 2 * math.pi)
    reach = min(lidar.range_max, float(model["reach_min"]))
    model |= {"fov_min": view, "reach_min": reach}
    scan = {"fov_min": view, "fov_max": view, "reach_min": reach, "thinning": 2}
    return merged({"model": model, "scan": scan}, changes)


def check_begun(folder: Path, made_of: dict[str, str], config: str) -> None:
    """Note what a network is made of, and how; UserError unless the one in ``folder``, if any, is of the same."""
    record, fields = folder.with_suffix(".json"), folder.with_suffix(".yaml")
    if folder.exists() and (json.loads(record.read_text()) if record.is_file() else None) != made_of:
        why = f"trained on another map, or from another network, or {record.name} beside it is lost"
        raise UserError(f"{folder}: {why}; delete it to train again")
    if folder.exists() and fields.is_file() and fields.read_text() != config:
        raise UserError(f"{folder}: trained with other fields ({fields.name} beside it); delete it to train again")
    write_atomic(record, json.dumps(made_of).encode())
    write_atomic(fields, config.encode())


def filter_settings(kind: str, start: Path, lidar: LidarConfig, changes: dict[str, Any]) -> dict[str, Any]:
    """Fields of ``FilterTrainConfig`` for scans of ``lidar``, on top of the network in ``start``."""
    view = checkpoint.load(start, kind=kind).config.view
    reach = min(lidar.range_max, view.reach_min)
    scans = {"fov_min": min(lidar.fov, 2 * math.pi), "reach_min": reach}
    model = merged(checkpoint.load_provenance(start, kind)["model"], {"view": scans})
    data = {"lidar": asdict(lidar), "beam_step": view.beam_step(lidar)}
    return merged({"model": model, "data": data}, changes)


class Site(NamedTuple):
    """Where networks are trained on: a map's file and digest, the lidar of its logs, and the folder for networks."""

    map_yaml: Path
    map_digest: str
    lidar: LidarConfig
    folder: Path


def adapt(plan: ProtocolPlan, site: Site, start: Path) -> Path:
    """Folder of the DSOM adapted to a map."""
    if not plan.adapt_minutes > 0:
        return start
    length = ("steps", plan.adapt_steps) if plan.adapt_steps else ("minutes", plan.adapt_minutes)
    return train_on(("dsom_jax.train",), settings(start, site.lidar, plan.adapt), length, site, start, "")


def adapt_filter(plan: ProtocolPlan, site: Site, start: Path, kind: str) -> Path:
    """Folder of the PF-Net or PFRNN, as ``kind`` says, trained on in a map."""
    if not plan.learn_steps:
        return start
    command = ("dsom_jax.train_filter", "--filter", kind)
    fields = filter_settings(kind, start, site.lidar, plan.learn)
    return train_on(command, fields, ("steps", plan.learn_steps), site, start, f"-{kind}")


def train_on(
    command: tuple[str, ...], fields: dict[str, Any], length: tuple[str, float], site: Site, start: Path, suffix: str
) -> Path:
    """Folder of a network trained on from ``start``; a training that was killed goes on where it was."""
    unit, amount = length
    folder = site.folder.with_name(f"{site.folder.name}{suffix}-{amount:.9g}-{unit.removesuffix('utes')}")
    check_begun(folder, {"map": site.map_digest, "start": checkpoint.digest(start)}, yaml.safe_dump(fields))
    config = folder.with_suffix(".yaml")
    words = ["--maps", site.map_yaml, "--init", start, "--config", config, f"--{unit}", amount, "--out", folder]
    done = subprocess.run([sys.executable, "-m", *command, *map(str, words), "--resume"])
    if done.returncode:
        raise UserError(f"{folder}: training on {site.map_yaml.name} failed; its message is above")
    return folder
