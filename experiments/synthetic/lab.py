"""What the experiments share: the suite, the networks, settings, and what one experiment (a piece) consists of.

A piece has jobs. A job computes numbers and nothing else, and they are kept as ``results/PIECE.JOB.json``; figures
and the section of the report are made from what is kept, so that they can be drawn again without running anything.
"""

from __future__ import annotations

import io
import json
import math
import os
import platform
import time
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from matplotlib.figure import Figure

from dsom_jax import bench, checkpoint, report
from dsom_jax.atomic import write_atomic
from dsom_jax.compiling import run_options
from dsom_jax.data.suite import Suite, load_suite
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError
from dsom_jax.filters.methods import build_filter, network_of, powers_of, sharp
from dsom_jax.filters.settings import WEIGHT_POWER
from dsom_jax.judging.run_table import RunTable, stored
from dsom_jax.montecarlo import run_keys
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.run_folder import commit
from dsom_jax.types import Filter, Key, Proposal

C = TypeVar("C")
T = TypeVar("T")
SCALED = ("runs", "worlds", "repeats")
"""Fields of configurations that ``--runs`` scales, in proportion to 100."""
PROPOSALS = {
    "dsom": ("DSOM", "#d62728"),
    "likelihood_grid": ("likelihood grid", "#ff7f0e"),
    "hybrid": ("hybrid", "#b5179e"),
}
"""Proposals that are compared: what figures call them, and their colours."""
NETWORKS = ("dsom", "pf_net", "pfrnn")
POWERS = powers_of("adam_sharp_dsom")
"""Powers of Eq 15 by which filters draw and average; part of what results depend on."""
Results = Mapping[str, dict[str, Any]]
"""What the jobs of one piece gave, by job."""
Everything = Mapping[str, Results]
"""The results of all pieces, by piece."""


@dataclass
class Lab:
    """The suite and the shipped networks, loaded when they are first needed.

    Attributes:
        seed: of all randomness.
        sources: proposals that were made, by the name of the map.
        piece: what runs at present.
        shared: what its jobs have in common, by what it depends on.
        commit: of the code when this process began.
    """

    seed: int = 0
    sources: dict[str, dict[str, Proposal]] = field(default_factory=dict)
    piece: str = ""
    shared: dict[Any, Any] = field(default_factory=dict)
    commit: str = field(default_factory=commit)

    def enter(self, piece: str) -> None:
        """Begin with a job of a piece: what was made for another will not be used again, and takes memory."""
        if piece != self.piece:
            jax.clear_caches()
            self.shared.clear()
        self.piece = piece

    @cached_property
    def suite(self) -> Suite:
        """synthetic-v1: six drives through two buildings that no training saw, one kidnapping each."""
        return load_suite("synthetic-v1")

    @cached_property
    def networks(self) -> dict[str, Any]:
        """The shipped networks by kind."""
        found = {}
        for kind in NETWORKS:
            folder = checkpoint.shipped(kind)
            if folder is None:
                raise UserError(f"checkpoints/{kind.replace('_', '-')}: not there; run this from the repository")
            found[kind] = checkpoint.load(folder, self.suite.lidar, kind=kind)
        return found

    @cached_property
    def origins(self) -> dict[str, str]:
        """Digests of the shipped networks: results of others are not of this repository."""
        folders = {kind: checkpoint.shipped(kind) for kind in NETWORKS}
        return {kind: checkpoint.digest(folder) for kind, folder in folders.items() if folder}

    def keys(self, runs: int) -> list[Key]:
        """Keys of the runs of each sequence: the same for all methods and settings."""
        return [run_keys(self.seed, number, runs) for number in range(len(self.suite.episodes))]

    def build(
        self,
        name: str,
        where: str,
        grid: OccupancyGrid,
        episode: Episode,
        particles: int = 200,
        t_cut: float = 0.6,
        weight_power: float = WEIGHT_POWER,
    ) -> Filter:
        """Filter of a method of :data:`dsom_jax.filters.methods.METHODS` on the map called ``where``.

        Whatever weighs by Eq 15 is taken sharpened (``_sharp``), by ``weight_power``; results name it without that.
        """
        network = self.networks.get(network_of(name) or "")
        made = self.sources.setdefault(where, {})
        own: dict[str, Any] = {
            "particles": particles, "t_cut": t_cut, "weight_power": weight_power, "episode": episode,
        }  # fmt: skip
        return jax.block_until_ready(
            build_filter(sharp(name), grid, self.suite.lidar, **own, checkpoint=network, sources=made)
        )

    def by_sequence(self, work: Callable[..., T]) -> list[T]:
        """``work(number, map's name, map, episode)`` of each sequence, one after the other.

        Not in threads: beside another computation in one process, some runs with DSOM and hybrid came out otherwise.
        """
        return [work(number, *parts) for number, parts in enumerate(self.suite.episodes)]

    def compare(self, name: str, settings: bench.BenchSettings) -> tuple[dict[str, Any], bench.Record]:
        """A method on all sequences: its entry of ``bench.json``, and all of its runs."""
        chosen = {"particles": settings.particles, "t_cut": settings.t_cut, "weight_power": settings.weight_power}
        build: bench.Build = partial(self.build, **chosen)  # type: ignore[arg-type]
        record = bench.run_method(name, self.suite, self.keys(settings.runs), build)
        return bench.summary(self.suite, {name: record}, settings)["methods"][name], record


Job = Callable[[Lab], dict[str, Any]]


class Piece(NamedTuple):
    """One experiment.

    Attributes:
        name: prefix of its results.
        config: a frozen dataclass; what the jobs depend on.
        jobs: name -> what computes it, from the configuration.
        figures: by name, from the results of all pieces.
        section: markdown, from the results of all pieces.
        timed: whether times of the jobs are shown, so that nothing may run beside them.
    """

    name: str
    config: Any
    jobs: Callable[[Any], dict[str, Job]]
    figures: Callable[[Everything], dict[str, Figure]]
    section: Callable[[Everything], str]
    timed: bool = False


def scaled(config: C, runs: int) -> C:
    """The configuration with its numbers of runs, worlds and repeats in the proportion ``runs`` : 100, at least 1."""
    changes = {
        f.name: max(1, math.ceil(getattr(config, f.name) * runs / 100))
        for f in fields(config)  # type: ignore[arg-type]
        if f.name in SCALED
    }
    return replace(config, **changes)  # type: ignore[type-var]


def compiled(function: Callable[..., Any]) -> Any:
    """``function`` under jit, with the options of the Monte-Carlo runs."""
    return jax.jit(function, compiler_options=run_options())


def measured(job: Job, lab: Lab, config: Any) -> dict[str, Any]:
    """The numbers of a job, with its configuration, when, where and in what time it was made."""
    wall, cpu = time.perf_counter(), time.process_time()
    data = job(lab)
    made = {
        "config": asdict(config),
        "seed": lab.seed,
        "networks": lab.origins,
        "commit": lab.commit,
        "machine": machine(),
        "wall_s": time.perf_counter() - wall,
        "processor_s": time.process_time() - cpu,
    }
    return {"made": made, **data}


def machine() -> dict[str, Any]:
    """Where numbers were taken, and how busy it was."""
    processor = next((line.split(":")[1].strip() for line in _cpuinfo() if line.startswith("model name")), "")
    return {
        "processor": processor or platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load": os.getloadavg()[0],
        "device": f"{jax.device_count()} x {jax.devices()[0].device_kind}",
        "jax": jax.__version__,
        "python": platform.python_version(),
    }


def _cpuinfo() -> list[str]:
    try:
        return Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return []


def write(path: Path, data: dict[str, Any]) -> None:
    """What a job gave: numbers as strict JSON on as few lines as can be read, with six digits, tables of runs and other
    arrays in a compressed file beside it. NaN and infinities of JSON become null."""
    arrays: dict[str, np.ndarray] = {}

    def packed(value: Any, place: str) -> Any:
        if isinstance(value, RunTable):
            return {"table": [packed(column, f"{place}/{name}") and name for name, column in stored(value).items()]}
        if isinstance(value, np.ndarray):
            arrays[place] = value
            return {"array": place}
        return {key: packed(v, f"{place}/{key}") for key, v in value.items()} if isinstance(value, dict) else value

    text = {key: packed(value, key) for key, value in data.items()}
    if arrays:
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]  # allow_pickle is not among them
        write_atomic(path.with_suffix(".npz"), buffer.getvalue())
    report.write_rows(path, report.rounded(report.plain(text)))


def read(path: Path) -> dict[str, Any]:
    """What :func:`write` wrote; UserError for anything else."""
    try:
        found: dict[str, Any] = json.loads(path.read_text())
        beside = path.with_suffix(".npz")
        arrays = dict(np.load(beside)) if beside.is_file() else {}

        def unpacked(value: Any, place: str) -> Any:
            if not isinstance(value, dict):
                return value
            if set(value) == {"table"}:
                return RunTable(*(arrays[f"{place}/{name}"] for name in value["table"]))
            if set(value) == {"array"}:
                return arrays[value["array"]]
            return {key: unpacked(v, f"{place}/{key}") for key, v in value.items()}

        return {key: unpacked(value, key) for key, value in found.items()}
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
        raise UserError(f"{path}: not a result of these experiments; delete it and run again") from None


def result_path(folder: Path, piece: str, job: str) -> Path:
    """Where the numbers of a job are kept."""
    return folder / f"{piece}.{job.replace(' ', '_')}.json"


def column(values: Any) -> np.ndarray:
    """A list of numbers of a results file as an array; null is NaN."""
    return np.array([math.nan if v is None else v for v in values], float)
