"""All methods on the clips of one map, each in files of its own, so that an interrupted series goes on."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dsom_jax import bench, checkpoint, plotting, report
from dsom_jax.data.suite import Suite
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError
from dsom_jax.filters.methods import COMBINATIONS, LEARNED, make_filter, make_proposal, network_of, powers_of, sharp
from dsom_jax.filters.settings import DRAWN, PARTS, REAL, sharp_powers
from dsom_jax.judging.run_table import RunTable, read_runs, write_runs
from dsom_jax.judging.scores import judged_by
from dsom_jax.montecarlo import run_keys
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.proposals.dual_features import with_episode
from dsom_jax.protocol.digests import clips_digest, map_digest
from dsom_jax.protocol.plan import ProtocolPlan, Variant
from dsom_jax.run_folder import commit
from dsom_jax.types import Filter, Proposal

Networks = Callable[[Variant], Path | None]
"""Folder of the network that a variant needs."""


class Builder:
    """Filters on the map of a suite; proposals are made once for each network.

    Whatever weighs by Eq 15 is taken sharpened (``_sharp``); plans and results name it without that.
    """

    def __init__(self, plan: ProtocolPlan, suite: Suite, networks: Networks) -> None:
        self.plan, self.suite, self.networks = plan, suite, networks
        self.made: dict[Path | None, dict[str, Proposal]] = {}
        self.commit = commit()[:7]

    def __call__(self, variant: Variant, grid: OccupancyGrid, episode: Episode) -> Filter:
        plan, lidar = self.plan, self.suite.lidar
        base = DRAWN if plan.map_kind == "drawn" else REAL
        settings = replace(base, particles=plan.particles, t_cut=variant.t_cut or base.t_cut, seed=plan.seed)
        folder, kind = self.networks(variant), network_of(variant.method)
        network = checkpoint.load(folder, lidar, kind=kind) if folder and kind else None
        if variant.method in LEARNED:
            return LEARNED[variant.method](network, grid, lidar, plan.particles)
        algorithm, source = COMBINATIONS[sharp(variant.method)]
        settings = replace(settings, powers=sharp_powers(source.removesuffix("_star")))
        name, made = source.removesuffix("_star"), self.made.setdefault(folder, {})
        for needed in (*PARTS.get(name, ()), name):
            if needed not in made:
                made[needed] = make_proposal(needed, grid, lidar, settings, network, made)
        starred = source != name
        proposal = with_episode(made[name], episode) if starred else made[name]  # type: ignore[arg-type]
        return make_filter(algorithm, proposal, grid, lidar, settings)


def run_variant(
    variant: Variant, plan: ProtocolPlan, suite: Suite, build: Builder, made_of: dict[str, Any], out: Path, work: Path
) -> None:
    """One method on all clips: OUT/STEM.json, with what it is ``made_of``, every run in STEM.npz, a picture in WORK."""
    keys = [run_keys(plan.seed, number, plan.runs) for number in range(len(suite.episodes))]
    record = bench.run_method(variant.method, suite, keys, lambda _, __, grid, episode: build(variant, grid, episode))
    shared = bench.BenchSettings(plan.runs, plan.particles, variant.t_cut or plan.t_cuts[0], plan.seed)
    entry = bench.summary(suite, {variant.method: record}, shared)["methods"][variant.method]
    _draw(variant, suite, record, work)
    facts = {"variant": variant.name, "t_cut": variant.t_cut, **made_of, "commit": build.commit}
    facts["network"] = network_facts(build.networks(variant), variant)
    write_runs(out / f"{variant.stem}.npz", record.table, evolution=plotting.bands_of(record.traces))
    report.write_json(out / f"{variant.stem}.json", facts | entry)


def network_facts(folder: Path | None, variant: Variant) -> dict[str, Any] | None:
    """What a variant draws from: which maps it was last trained on, and how long; None without a network."""
    kind = network_of(variant.method)
    if folder is None or kind is None:
        return None
    record = checkpoint.load_provenance(folder, kind)
    shipped = folder == checkpoint.shipped(kind)
    return {
        "shipped": shipped,
        "digest": checkpoint.digest(folder),
        **{name: record.get(name) for name in ("data", "steps", "samples", "seconds", "commit")},
    }


def identity(variant: Variant, plan: ProtocolPlan, suite: Suite, start: Path | None) -> dict[str, Any]:
    """What must be the same for a result to be kept; ``start`` is the network that it uses, or that was trained on."""
    return trained_on(variant, plan) | {
        "suite": suite.name, "map_kind": plan.map_kind, "runs": plan.runs, "particles": plan.particles,
        "clips": plan.clips, "updates": plan.updates, "seed": plan.seed, "laser_max_range": plan.laser_max_range,
        "map_digest": map_digest(suite.episodes[0][1]), "clips_digest": clips_digest(suite),
        "start_digest": start and checkpoint.digest(start), "powers": report.plain(powers_of(sharp(variant.method))),
    }  # fmt: skip


def trained_on(variant: Variant, plan: ProtocolPlan) -> dict[str, Any]:
    """How the network of a variant is trained on in the map; nothing if it has none, or uses it as it is shipped."""
    kind = network_of(variant.method)
    if kind is None or variant.shipped:
        return {}
    names = ("adapt_minutes", "adapt_steps", "adapt") if kind == "dsom" else ("learn_steps", "learn")
    return {name: getattr(plan, name) for name in names}


def is_done(variant: Variant, made_of: dict[str, Any], out: Path) -> bool:
    """Whether the results of a variant are there with all runs, and :func:`identity` was the same."""
    found = read_entry(out, variant)
    return (found is not None and (out / f"{variant.stem}.npz").is_file()
            and all(found.get(k) == value for k, value in made_of.items()))  # fmt: skip


def read_table(out: Path, variant: Variant) -> RunTable:
    """Every run of a variant, under its name."""
    table = read_runs(out / f"{variant.stem}.npz")
    return table._replace(method=np.full(len(table.run), variant.stem))


def read_evolution(out: Path, variant: Variant) -> np.ndarray:
    """Bands of each clip (clips, 3, T), see :func:`.plotting.bands_of`."""
    with np.load(out / f"{variant.stem}.npz") as kept:
        return kept["evolution"]


def read_entry(out: Path, variant: Variant) -> dict[str, Any] | None:
    """What :func:`run_variant` wrote, None if there is nothing; UserError for anything else."""
    path = out / f"{variant.stem}.json"
    if not path.is_file():
        return None
    try:
        found = json.loads(path.read_text())
    except ValueError as error:
        raise UserError(f"{path}: not JSON ({error}); delete it to have it made again") from None
    if not isinstance(found, dict):
        raise UserError(f"{path}: not a result; delete it to have it made again")
    return found


def _draw(variant: Variant, suite: Suite, record: bench.Record, work: Path) -> None:
    """Particles and PM of the first run of the first clip at four moments."""
    _, grid, episode = suite.episodes[0]
    estimates = getattr(record.result.info, judged_by(variant.method))[0]
    figure = plotting.moment_figure(
        grid, suite.lidar, episode, record.filter, bench.picture_updates(episode), record.result.kept.poses, estimates
    )
    plotting.save_figure(figure, work / f"{variant.stem}.png")
