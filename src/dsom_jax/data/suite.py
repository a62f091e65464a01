"""Suites of simulated drives: the frozen ones shipped with the package, and a user's own, listed in a TOML file.

A TOML suite has one table per drive, and one lidar for all of them; only ``map`` or ``world`` is required::

    name = "my office"
    [lidar]
    beams = 180                 # any field of LidarConfig
    [[episodes]]
    map = "office.yaml"         # ROS map, relative to this file; or world = 7, seed of a procedural building
    resolution = 0.1            # metres per cell to resample the map to; for a world, 1/3
    cells = 128                 # side of the world, cells
    seed = 3                    # of the drive
    updates = [70, 70]          # in each phase, a kidnapping between phases
    obstacles = 20              # likewise removed, kidnap_distance, update_min_d, update_min_a, near, margin
    range_sigma = 0.03          # noise of the ranges, metres
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax.atomic import write_atomic
from dsom_jax.data.documents import read_toml
from dsom_jax.data.files import read_arrays
from dsom_jax.data.open_map import load_map
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError, shown
from dsom_jax.lidar import LidarConfig, LidarNoise
from dsom_jax.occupancy import OccupancyGrid, from_cells, resample
from dsom_jax.simulate.drive import DriveConfig, make_synthetic
from dsom_jax.simulate.worlds import WorldConfig, make_world

NO_RETURN, TOO_CLOSE, INVALID = 65535, 65534, 65533
"""Codes of +inf, -inf and NaN among ranges in millimetres."""

DRIVE_FIELDS = ("updates", "obstacles", "removed", "kidnap_distance", "update_min_d", "update_min_a", "near", "margin")
EPISODE_FIELDS = ("map", "world", "cells", "resolution", "seed", "name", "range_sigma", *DRIVE_FIELDS)


@dataclass(frozen=True)
class Suite:
    """Drives that methods are compared on.

    Attributes:
        name: of the suite.
        lidar: sensor of all drives.
        train_maps: maps that may be trained on; empty for a user's own suite.
        episodes: (name of the map, map, drive); the map is what the robot believes, not the true world.
    """

    name: str
    lidar: LidarConfig
    train_maps: tuple[OccupancyGrid, ...]
    episodes: tuple[tuple[str, OccupancyGrid, Episode], ...]


def load_suite(name: str | Path) -> Suite:
    """A frozen suite by name (``synthetic-v1``), or the one that a TOML file lists."""
    if str(name).endswith(".toml"):
        return _from_toml(Path(name))
    frozen = {Path(entry.name).stem: entry for entry in files("dsom_jax").joinpath("suites").iterdir()}
    frozen = {stem: entry for stem, entry in frozen.items() if entry.name.endswith(".npz")}
    if str(name) not in frozen:
        raise UserError(f"suite = {name}: no such suite; give one of {', '.join(sorted(frozen))}, or a .toml file")
    return decode(str(name), frozen[str(name)].read_bytes())


def encode(suite: Suite) -> bytes:
    """A suite whose maps share one shape and whose drives one length, as npz: ranges rounded to millimetres."""
    maps = {f"train-{n}": grid for n, grid in enumerate(suite.train_maps)}
    maps |= {name: grid for name, grid, _ in suite.episodes}
    names = list(maps)
    drives = [episode for _, _, episode in suite.episodes]
    rest = {name: np.stack([np.asarray(getattr(drive, name)) for drive in drives]) for name in Episode._fields[1:]}
    arrays: dict[str, Any] = dict(
        lidar=np.array([suite.lidar.beams, suite.lidar.angle_min, suite.lidar.angle_increment, suite.lidar.range_max]),
        names=np.array(names),
        shape=np.array(next(iter(maps.values())).shape),
        resolution=np.array(next(iter(maps.values())).resolution),
        occupied=np.stack([np.packbits(np.asarray(grid.occupied)) for grid in maps.values()]),
        free=np.stack([np.packbits(np.asarray(grid.free)) for grid in maps.values()]),
        map_of=np.array([names.index(name) for name, _, _ in suite.episodes]),
        ranges=np.stack([_to_millimetres(np.asarray(drive.ranges)) for drive in drives]),
        **rest,
    )
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def decode(name: str, content: bytes) -> Suite:
    """The suite that :func:`encode` wrote."""
    data = read_arrays(content, f"suite {name}")
    try:
        return _decode(name, data)
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, ArithmeticError) as error:
        raise UserError(f"suite {name}: its file is damaged ({error}); install the package again") from None


def _decode(name: str, data: dict[str, np.ndarray]) -> Suite:
    """The suite in the arrays of :func:`encode`."""
    beams, angle_min, increment, range_max = data["lidar"].tolist()
    grids = [_unpack(data, number) for number in range(len(data["names"]))]
    names = [str(n) for n in data["names"]]
    train = tuple(grid for n, grid in zip(names, grids, strict=True) if n.startswith("train-"))
    episodes = tuple(
        (names[m], grids[m], _unpack_episode(data, number)) for number, m in enumerate(data["map_of"].tolist())
    )
    return Suite(name, LidarConfig(int(beams), angle_min, increment, range_max=range_max), train, episodes)


def save_suite(path: str | Path, suite: Suite) -> None:
    """Freeze a suite."""
    write_atomic(path, encode(suite))


def _unpack(data: dict[str, np.ndarray], number: int) -> OccupancyGrid:
    height, width = data["shape"].tolist()
    occupied, free = (
        jnp.asarray(np.unpackbits(data[part][number], count=height * width).reshape(height, width).astype(bool))
        for part in ("occupied", "free")
    )
    return from_cells(occupied, free, resolution=float(data["resolution"]))


def _unpack_episode(data: dict[str, np.ndarray], number: int) -> Episode:
    rest = (jnp.asarray(data[field][number]) for field in Episode._fields[1:])
    return Episode(jnp.asarray(_from_millimetres(data["ranges"][number])), *rest)


def _to_millimetres(ranges: np.ndarray) -> np.ndarray:
    codes = np.where(np.isnan(ranges), INVALID, np.where(ranges > 0, NO_RETURN, TOO_CLOSE))
    finite = np.isfinite(ranges)
    return np.where(finite, np.rint(1000 * np.where(finite, ranges, 0.0)), codes).astype(np.uint16)


def _from_millimetres(codes: np.ndarray) -> np.ndarray:
    ranges = codes.astype(np.float32) / np.float32(1000)
    for code, value in ((NO_RETURN, np.inf), (TOO_CLOSE, -np.inf), (INVALID, np.nan)):
        ranges[codes == code] = value
    return ranges


def _from_toml(path: Path) -> Suite:
    document = read_toml(path, "suite file")
    _known(path, "the suite", document, ("name", "lidar", "episodes"))
    entries = document.get("episodes")
    if not isinstance(entries, list) or not entries or not all(isinstance(e, Mapping) for e in entries):
        raise UserError(f'{path}: lists no drives; add at least one table [[episodes]] with map = "FILE.yaml"')
    lidar = _lidar(path, document.get("lidar", {}))
    episodes = tuple(_episode(path, f"episodes[{n}]", entry, lidar) for n, entry in enumerate(entries))
    return Suite(str(document.get("name", path.stem)), lidar, (), episodes)


def _known(path: Path, where: str, table: Mapping[str, Any], allowed: tuple[str, ...]) -> None:
    for field in table:
        if field not in allowed:
            raise UserError(f"{path}: {where} has an unknown field '{field}'; the fields are {', '.join(allowed)}")


def _lidar(path: Path, table: Any) -> LidarConfig:
    if not isinstance(table, Mapping):
        raise UserError(f"{path}: lidar = {shown(table)}: must be a table [lidar]")
    _known(path, "lidar", table, tuple(f.name for f in fields(LidarConfig)))
    values: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}
    try:
        return LidarConfig(**values)
    except (TypeError, ValueError) as error:
        raise UserError(f"{path}: lidar: {error}") from None


def _episode(
    path: Path, where: str, entry: Mapping[str, Any], lidar: LidarConfig
) -> tuple[str, OccupancyGrid, Episode]:
    """Name, map and simulated drive of one table of a TOML suite."""
    _known(path, where, entry, EPISODE_FIELDS)
    seed = _number(path, where, entry, "seed", 0, whole=True)
    name, grid = _map(path, where, entry)
    try:
        _, episode = make_synthetic(seed, grid, _drive(path, where, entry, lidar))
    except UserError as error:
        raise UserError(f"{path}: {where}: {error}") from None
    return str(entry.get("name", name)), grid, episode


def _drive(path: Path, where: str, entry: Mapping[str, Any], lidar: LidarConfig) -> DriveConfig:
    values: dict[str, Any] = {}
    for field in DRIVE_FIELDS[1:]:
        if field in entry:
            values[field] = _number(path, where, entry, field, 0, whole=field in ("obstacles", "removed"))
    updates = entry.get("updates", [70, 70])
    if not isinstance(updates, list) or not all(type(n) is int for n in updates):
        raise UserError(f"{path}: {where}: updates = {shown(updates)}: must be whole numbers such as [70, 70]")
    noise = LidarNoise(sigma=_number(path, where, entry, "range_sigma", 0.03))
    try:
        return replace(DriveConfig(lidar=lidar, lidar_noise=noise), updates=tuple(updates), **values)
    except ValueError as error:
        raise UserError(f"{path}: {where}: {error}") from None


def _map(path: Path, where: str, entry: Mapping[str, Any]) -> tuple[str, OccupancyGrid]:
    """Name and map of a drive: a ROS map or a procedural building."""
    if ("map" in entry) == ("world" in entry):
        raise UserError(f'{path}: {where}: give either map = "FILE.yaml" or world = SEED')
    if "map" in entry:
        grid = load_map(path.parent / str(entry["map"]))
        resolution = _number(path, where, entry, "resolution", grid.resolution, positive=True)
        return Path(str(entry["map"])).stem, grid if resolution == grid.resolution else resample(grid, resolution)
    seed = _number(path, where, entry, "world", 0, whole=True)
    try:
        config = WorldConfig(
            cells=_number(path, where, entry, "cells", 128, whole=True),
            resolution=_number(path, where, entry, "resolution", 1 / 3, positive=True),
        )
    except ValueError as error:
        raise UserError(f"{path}: {where}: {error}") from None
    return f"world-{seed}", jax.jit(make_world, static_argnums=1)(jax.random.key(seed), config)


def _number(
    path: Path,
    where: str,
    entry: Mapping[str, Any],
    field: str,
    default: Any,
    whole: bool = False,
    positive: bool = False,
) -> Any:
    """A field that must be a number and not negative."""
    value = entry.get(field, default)
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)) or not 0 <= value < 2**31:
        raise UserError(f"{path}: {where}: {field} = {shown(value)}: must be a {'whole ' * whole}number, not negative")
    if positive and not value:
        raise UserError(f"{path}: {where}: {field} = {value!r}: must be positive")
    return value
