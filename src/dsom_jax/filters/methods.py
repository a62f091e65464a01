"""From a name and a map to a filter: every combination that benchmarks and command lines offer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import jax

from dsom_jax.belief.grid_belief import GridBelief, grid_belief
from dsom_jax.belief.monitor import monitor
from dsom_jax.belief.verdict import SHIPPED_HEAD, Head
from dsom_jax.belief.watched import Watched
from dsom_jax.episode import Episode
from dsom_jax.filters.adam import AdamMCL
from dsom_jax.filters.adam_memory import AdamMemory, AdamPlaces
from dsom_jax.filters.adam_robust import AdamRobust
from dsom_jax.filters.mcl import MCL
from dsom_jax.filters.mixture import MixtureMCL
from dsom_jax.filters.pf_net import pf_net
from dsom_jax.filters.pfrnn import pfrnn
from dsom_jax.filters.settings import PARTS, WEIGHT_POWER, Settings, sharp_powers, table_for, within_reach
from dsom_jax.filters.updates import FilterConfig
from dsom_jax.filters.world import World
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.proposals.dsom import DSOMProposal, dsom
from dsom_jax.proposals.dual_features import DualFeaturesConfig, dual_features, with_episode
from dsom_jax.proposals.hybrid import Hybrid
from dsom_jax.proposals.likelihood_grid import LikelihoodGrid, likelihood_grid
from dsom_jax.proposals.markov_grid import MarkovGrid
from dsom_jax.proposals.markov_network import MarkovNetwork
from dsom_jax.proposals.uniform import free_space
from dsom_jax.raycast import make_tables
from dsom_jax.types import Filter, Proposal

Algorithm = Literal["mcl", "mcl_sharp", "mixture_mcl", "mixture_mcl_sharp", "adam", "adam_sharp", "adam_robust"]
"""``_sharp``: Eq 15 to a power (:attr:`Settings.powers`); without it, weights as the paper prints them."""

_BY_SCORE: dict[str, tuple[Algorithm, str]] = {
    "mcl": ("mcl", "uniform"),
    "mixture_mcl": ("mixture_mcl", "dual_features"),
    "mixture_mcl_star": ("mixture_mcl", "dual_features_star"),
    "mixture_mcl_dsom": ("mixture_mcl", "dsom"),
    "adam_dsom": ("adam", "dsom"),
    "adam_likelihood_grid": ("adam", "likelihood_grid"),
    "adam_hybrid": ("adam", "hybrid"),
    "adam_markov_grid": ("adam", "markov_grid"),
    "adam_markov_dsom": ("adam", "markov_dsom"),
    "adam_markov_hybrid": ("adam", "markov_hybrid"),
}


def sharp(method: str) -> str:
    """Name of the method that is ``method`` with weights to a power: ``adam_dsom`` -> ``adam_sharp_dsom``.

    Methods that do not weigh by Eq 15 keep their names.
    """
    algorithm = _BY_SCORE[method][0] if method in _BY_SCORE else ""
    return method.replace(algorithm, f"{algorithm}_sharp", 1) if algorithm else method


_SHARP: dict[Algorithm, Algorithm] = {"mcl": "mcl_sharp", "mixture_mcl": "mixture_mcl_sharp", "adam": "adam_sharp"}
COMBINATIONS: dict[str, tuple[Algorithm, str]] = {
    **_BY_SCORE,
    **{sharp(name): (_SHARP[algorithm], source) for name, (algorithm, source) in _BY_SCORE.items()},
    "robust_dsom": ("adam_robust", "dsom"),
    "robust_likelihood_grid": ("adam_robust", "likelihood_grid"),
    "robust_hybrid": ("adam_robust", "hybrid"),
    "robust_markov_grid": ("adam_robust", "markov_grid"),
    "robust_markov_dsom": ("adam_robust", "markov_dsom"),
    "robust_markov_hybrid": ("adam_robust", "markov_hybrid"),
}
LEARNED: dict[str, Callable[..., Filter]] = {"pf_net": pf_net, "pfrnn": pfrnn}
"""Filters that are networks themselves; each has the name of its kind of network."""
_STAR = "_star"
METHODS: tuple[str, ...] = (*COMBINATIONS, *LEARNED)
STANDARD = (
    "mcl", "mixture_mcl", "mixture_mcl_star", "mixture_mcl_dsom", "adam_dsom", "adam_likelihood_grid",
    "adam_sharp_dsom", "adam_sharp_likelihood_grid", "robust_dsom", "robust_likelihood_grid",
)  # fmt: skip
"""Methods of the standard comparison; the others have to be asked for by name."""


def network_of(method: str) -> str | None:
    """Kind of the trained network that a method of :data:`METHODS` needs: ``dsom``, ``pf_net``, ``pfrnn`` or none."""
    if method in LEARNED:
        return method
    return "dsom" if COMBINATIONS[method][1].endswith(("dsom", "hybrid")) else None


def powers_of(method: str, weight_power: float = WEIGHT_POWER) -> tuple[float, float] | None:
    """Powers by which a method of :data:`METHODS` draws and averages; None for those that do not weigh by Eq 15."""
    if method in LEARNED or COMBINATIONS[method][0] == "adam_robust":
        return None
    algorithm, proposal = COMBINATIONS[method]
    return sharp_powers(proposal, weight_power) if algorithm.endswith("_sharp") else (1.0, 1.0)


def build_filter(
    name: str,
    grid: OccupancyGrid,
    lidar: LidarConfig,
    *,
    particles: int,
    t_cut: float,
    weight_power: float = WEIGHT_POWER,
    episode: Episode | None = None,
    checkpoint: Any = None,
    sources: dict[str, Proposal] | None = None,
) -> Filter:
    """Filter ``name`` of :data:`METHODS` as the benchmark runs it.

    ``episode`` is needed by ``mixture_mcl_star`` only; ``checkpoint`` is the network that :func:`network_of` names, a
    DSOM as an evaluation view; ``sources`` holds the proposals that were made for this map before, by name: what is
    missing is made and put there.
    """
    if name in LEARNED:
        return LEARNED[name](checkpoint, grid, lidar, particles)
    algorithm, proposal = COMBINATIONS[name]
    sources, base = {} if sources is None else sources, proposal.removesuffix(_STAR)
    settings = Settings(particles=particles, t_cut=t_cut, powers=sharp_powers(base, weight_power))
    for needed in (*PARTS.get(base, ()), base):
        if needed not in sources:
            sources[needed] = make_proposal(needed, grid, lidar, settings, checkpoint, sources)
    starred = episode is not None and proposal.endswith(_STAR)
    source = with_episode(sources[base], episode) if starred else sources[base]  # type: ignore[arg-type]
    return make_filter(algorithm, source, grid, lidar, settings)


def make_proposal(
    name: str,
    grid: OccupancyGrid,
    lidar: LidarConfig,
    settings: Settings,
    checkpoint: Any = None,
    made: dict[str, Proposal] | None = None,
) -> Proposal:
    """Proposal ``name`` on a map; one that is put together of others takes those that are ``made`` already."""
    if name == "uniform":
        return free_space(grid)
    if name == "likelihood_grid":
        model = replace(settings.grid.model, range_max=lidar.range_max)
        return likelihood_grid(grid, lidar, replace(settings.grid, model=model))
    if name == "dsom":
        return dsom(checkpoint, grid, lidar, settings.sharpness, settings.raycast.surface)
    if name in ("hybrid", "markov_dsom", "markov_hybrid"):
        have = made or {}
        parts = (have.get(p) or make_proposal(p, grid, lidar, settings, checkpoint) for p in PARTS[name])
        likelihood, network = parts  # type: Any, Any  # as their names say
        if name == "hybrid":
            return Hybrid(likelihood, network, settings.hybrid)
        worth = settings.markov_dsom if name == "markov_dsom" else settings.markov_hybrid
        return MarkovNetwork(likelihood, settings.markov, network=network, worth=worth)
    if name == "markov_grid":
        single = (made or {}).get("likelihood_grid") or make_proposal("likelihood_grid", grid, lidar, settings)
        return remembering(single, settings)  # type: ignore[arg-type]  # as its name says
    if name == "dual_features":
        return dual_features(jax.random.key(settings.seed), grid, lidar, DualFeaturesConfig())
    raise ValueError(f"make_proposal: no proposal is called {name!r}")


def remembering(likelihood: LikelihoodGrid, settings: Settings) -> MarkovGrid:
    """The likelihood grid with a memory of earlier scans."""
    return MarkovGrid(likelihood.tempered(settings.memory_temper), settings.markov)


def make_filter(
    algorithm: Algorithm, proposal: Proposal, grid: OccupancyGrid, lidar: LidarConfig, settings: Settings
) -> Filter:
    """Filter ``algorithm`` drawing from ``proposal``; that of a network is sharpened as ``settings`` say for it."""
    if algorithm == "adam_robust":
        robust = replace(settings.robust, particles=settings.particles)
        sensor = within_reach(settings.robust_sensor, lidar)
        world = World.on(grid, lidar, settings.robust_motion, sensor, settings.robust_raycast, settings.max_beams)
        if isinstance(proposal, DSOMProposal):
            proposal = replace(proposal, sharpness=settings.robust_sharpness)
        if settings.memory and isinstance(proposal, LikelihoodGrid):
            belief = grid_belief(proposal, grid, settings.belief)
            return AdamPlaces(world, belief, robust, settings.memory_share)
        if isinstance(proposal, MarkovGrid):
            share = settings.network_share if isinstance(proposal, MarkovNetwork) else settings.memory_share
            return AdamMemory(world, proposal, robust, share)
        return AdamRobust(world, proposal, robust)
    sensor, raycast = within_reach(settings.sensor, lidar), table_for(grid.resolution, settings.raycast)
    world = World.on(grid, lidar, settings.motion, sensor, raycast, settings.max_beams)
    drawn, averaged = settings.powers if algorithm.endswith("_sharp") else (1.0, 1.0)
    config = FilterConfig(settings.particles, weight_power=drawn, estimate_power=averaged)
    if algorithm.startswith("mcl"):
        return MCL(world, config)
    if algorithm.startswith("mixture_mcl"):
        return MixtureMCL(world, proposal, config)
    return AdamMCL(world, proposal, config, settings.t_cut)


def watch(
    filter: Filter,
    grid: OccupancyGrid,
    lidar: LidarConfig,
    settings: Settings,
    estimate: str = "cluster",
    head: Head = SHIPPED_HEAD,
) -> Watched:
    """The filter with a verdict on its answers; one that draws from the belief over the grid shares it.

    ``estimate`` is the answer that is watched: the heaviest ``cluster``, or the ``mean`` as in the paper.
    """
    own: Any = getattr(filter, "proposal", None)
    drawn = isinstance(own, GridBelief)
    usable = isinstance(own, LikelihoodGrid | GridBelief)
    # Hybrid and markov_* hold one made with the same settings.
    held = own if usable else getattr(own, "likelihood", None)
    made = make_proposal("likelihood_grid", grid, lidar, settings) if held is None else held
    belief: Any = made if drawn else grid_belief(made, grid, settings.belief)  # type: ignore[arg-type]
    tables = make_tables(grid, settings.robust_raycast, lidar.range_max)
    return Watched(filter, belief, monitor(tables, lidar), drawn, head, estimate)
