"""From a name and a map to a filter: every combination that benchmarks and command lines offer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import jax

from dsom_jax import checks
from dsom_jax.belief.grid_belief import GridBeliefConfig, grid_belief
from dsom_jax.belief.monitor import monitor
from dsom_jax.belief.verdict import SHIPPED_HEAD, Head
from dsom_jax.belief.watched import Watched
from dsom_jax.episode import Episode
from dsom_jax.filters.adam import AdamMCL
from dsom_jax.filters.adam_memory import AdamMemory, AdamPlaces
from dsom_jax.filters.adam_robust import AdamRobust, RobustConfig
from dsom_jax.filters.mcl import MCL
from dsom_jax.filters.mixture import MixtureMCL
from dsom_jax.filters.pf_net import pf_net
from dsom_jax.filters.pfrnn import pfrnn
from dsom_jax.filters.updates import FilterConfig, World
from dsom_jax.lidar import LidarConfig
from dsom_jax.motion import OdometryMotion
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.proposals.dsom import DSOMProposal, dsom
from dsom_jax.proposals.dual_features import DualFeaturesConfig, dual_features, with_episode
from dsom_jax.proposals.hybrid import Hybrid, HybridConfig
from dsom_jax.proposals.likelihood_grid import LikelihoodGrid, LikelihoodGridConfig, likelihood_grid
from dsom_jax.proposals.markov_grid import MarkovGrid, MarkovGridConfig
from dsom_jax.proposals.markov_network import MarkovNetwork, MarkovNetworkConfig
from dsom_jax.proposals.uniform import free_space
from dsom_jax.raycast import RaycastConfig, make_tables
from dsom_jax.sensor import BeamModel, ScoreModel
from dsom_jax.types import Filter, Motion, Proposal

Algorithm = Literal["mcl", "mixture_mcl", "adam", "adam_robust"]

COMBINATIONS: dict[str, tuple[Algorithm, str]] = {
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
PARTS = {
    "hybrid": ("likelihood_grid", "dsom"),
    "markov_grid": ("likelihood_grid",),
    "markov_dsom": ("likelihood_grid", "dsom"),
    "markov_hybrid": ("likelihood_grid", "dsom"),
}
SURE = ("likelihood_grid", *PARTS)
"""Proposals that hold the exact likelihood of a scan, or what all scans so far say."""
METHODS: tuple[str, ...] = (*COMBINATIONS, *LEARNED)
STANDARD: tuple[str, ...] = tuple(name for name, (_, proposal) in COMBINATIONS.items() if proposal not in PARTS)
"""Methods of the standard comparison; the others have to be asked for by name."""


def network_of(method: str) -> str | None:
    """Kind of the trained network that a method of :data:`METHODS` needs: ``dsom``, ``pf_net``, ``pfrnn`` or none."""
    if method in LEARNED:
        return method
    return "dsom" if COMBINATIONS[method][1].endswith(("dsom", "hybrid")) else None


WEIGHT_POWER = 8.0
"""Default of :attr:`Settings.weight_power`."""


def powers(algorithm: str, sure: bool, weight_power: float) -> tuple[float, float]:
    """Powers of Eq 15 by which a filter that weighs by it draws and averages; is its proposal one of :data:`SURE`?

    Draws have to leave room for places that are only likely, an average has not: it goes by 16 where draws go by 8,
    and by 1, as printed, where they do (experiments/dsom/REPORT.md). Alg 1 with one of :data:`SURE` as its proposal
    draws as printed and averages by ``weight_power``: PM then is as good as sure, and what gathers sooner than PM
    arrives stays at a wrong place that looks alike.
    """
    if algorithm == "adam" and sure:
        return 1.0, weight_power
    return weight_power, round(weight_power ** (4 / 3), 9)


def powers_of(method: str, weight_power: float = WEIGHT_POWER) -> tuple[float, float] | None:
    """:func:`powers` of a method of :data:`METHODS`; None for those that do not weigh by Eq 15."""
    if method in LEARNED or COMBINATIONS[method][0] == "adam_robust":
        return None
    algorithm, proposal = COMBINATIONS[method]
    return powers(algorithm, proposal in SURE, weight_power)


@dataclass(frozen=True)
class Settings:
    """What all filters of a comparison share; ``range_max`` of the sensor models follows the lidar.

    Attributes:
        particles: N.
        t_cut: T_cut of Alg 1.
        max_beams: beams used for weighing.
        seed: of what is random while a filter is built (the samples of Mixture MCL).
        motion, score, raycast: drive, Eq 15 and expected ranges of the paper's filters; of a table on maps of coarse
            cells see :func:`table_for`.
        weight_power: particles are drawn by Eq 15 to this power, as if so many such scans had been seen; 1 as printed,
            where a particle elsewhere weighs half as much as one at the truth (experiments/REPORT.md). Estimates
            average by another, and Alg 1 with some proposals is an exception: :func:`powers`.
        grid: the likelihood grid.
        sharpness: exponent of DSOM's PM in the paper's filters (``experiments/dsom``).
        hybrid: weights of likelihood grid and network.
        robust, robust_motion, robust_raycast: AdaM robust; its ``particles`` are those above.
        robust_sharpness: exponent of DSOM's PM there, where draws are corrected for what they were drawn from.
        memory: AdaM robust with the likelihood grid as proposal remembers earlier scans on the grid.
        memory_share: least and greatest weight of what that memory says, beside the particles' own past.
        memory_temper: factor on a scan's log-likelihood in that memory, in place of the grid's own: where the map is
            wrong, scans taken one after another err alike.
        belief: the belief over the grid of AdaM robust with a memory, and of every verdict.
        markov: how the memories of Alg 1 and of the network move.
        markov_dsom, markov_hybrid: what a scan is worth in a memory of the network alone, and of it and the likelihood.
        network_share: as ``memory_share``, of a memory of the network.
    """

    particles: int = 200
    t_cut: float = 0.6
    max_beams: int = 72
    seed: int = 0
    motion: Motion = OdometryMotion()
    score: ScoreModel = ScoreModel()
    raycast: RaycastConfig = RaycastConfig("table")
    grid: LikelihoodGridConfig = LikelihoodGridConfig()
    weight_power: float = WEIGHT_POWER
    sharpness: float = 3.0
    hybrid: HybridConfig = HybridConfig()
    robust: RobustConfig = RobustConfig(model=BeamModel(0.65, 0.05, 0.05, 0.25, sigma_hit=0.1, temper=0.2))
    robust_motion: Motion = OdometryMotion(0.01, 0.01, 0.01, 0.01, 0.02, 0.015, slip=0.1, tail=0.4, tail_scale=4.0)
    robust_raycast: RaycastConfig = RaycastConfig("table")
    robust_sharpness: float = 1.0
    memory: bool = False
    memory_share: tuple[float, float] = (0.01, 0.5)
    memory_temper: float = 0.05
    belief: GridBeliefConfig = GridBeliefConfig()
    markov: MarkovGridConfig = MarkovGridConfig()
    markov_dsom: MarkovNetworkConfig = MarkovNetworkConfig()
    markov_hybrid: MarkovNetworkConfig = MarkovNetworkConfig(power=0.15, temper=0.01)
    network_share: tuple[float, float] = (0.5, 0.5)

    def __post_init__(self) -> None:
        checks.count(self, "particles max_beams")
        checks.count(self, "seed", 0)
        checks.share(self, "t_cut")
        checks.span(self, "memory_share")
        checks.span(self, "network_share")
        checks.positive(self, "weight_power sharpness robust_sharpness memory_temper")


_SCANNED = 1.0
"""Cells that a beam goes on behind the near edge of a wall mapped from scans: range noise makes walls thick.
Measured on three SLAM maps of 0.1 m cells: 0.09 to 0.10 m (median over their logs, ``experiments/robust``)."""

REAL = Settings(
    particles=500,
    max_beams=60,
    raycast=RaycastConfig("table", surface=_SCANNED),
    robust_raycast=RaycastConfig("exact", surface=_SCANNED),
    grid=LikelihoodGridConfig(raycast=RaycastConfig("exact", surface=_SCANNED)),
    memory=True,
)
"""What ``localize`` starts from, for maps made from scans."""

_FURNISHED = BeamModel(0.45, 0.4, 0.05, 0.1, sigma_hit=0.6)
DRAWN = replace(
    REAL,
    robust=replace(REAL.robust, model=replace(_FURNISHED, temper=0.1)),
    grid=replace(REAL.grid, model=replace(_FURNISHED, temper=0.1)),
)
"""For floor plans: walls elsewhere, furniture that cuts four beams in ten short (``experiments/robust``)."""


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
    settings = Settings(particles=particles, t_cut=t_cut, weight_power=weight_power)
    sources, base = {} if sources is None else sources, proposal.removesuffix(_STAR)
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


_COARSE = 0.2
"""Metres per cell above which the walls seen from its middle are not those seen from its corners."""


def table_for(resolution: float, config: RaycastConfig) -> RaycastConfig:
    """Coarse cells have four viewpoints, in half as many directions (``experiments/perf/raycast.py``)."""
    if config.method != "table" or resolution <= _COARSE:
        return config
    return replace(config, viewpoints=2 * config.viewpoints, angles=config.angles // 2)


def remembering(likelihood: LikelihoodGrid, settings: Settings) -> MarkovGrid:
    """The likelihood grid with a memory of earlier scans."""
    return MarkovGrid(likelihood.tempered(settings.memory_temper), settings.markov)


def make_filter(
    algorithm: Algorithm, proposal: Proposal, grid: OccupancyGrid, lidar: LidarConfig, settings: Settings
) -> Filter:
    """Filter ``algorithm`` drawing from ``proposal``; that of a network is sharpened as ``settings`` say for it."""
    step = -(-lidar.beams // settings.max_beams)
    used, space = lidar.every(step), free_space(grid)
    if algorithm == "adam_robust":
        model = replace(settings.robust.model, range_max=lidar.range_max)
        robust = replace(settings.robust, particles=settings.particles, model=model)
        tables = make_tables(grid, settings.robust_raycast, lidar.range_max)
        parts = (used, step, settings.robust_motion, robust)
        if isinstance(proposal, DSOMProposal):
            proposal = replace(proposal, sharpness=settings.robust_sharpness)
        if settings.memory and isinstance(proposal, LikelihoodGrid):
            belief = grid_belief(proposal, grid, settings.belief)
            return AdamPlaces(tables, space, belief, *parts, settings.memory_share)
        if isinstance(proposal, MarkovGrid):
            share = settings.network_share if isinstance(proposal, MarkovNetwork) else settings.memory_share
            return AdamMemory(tables, space, proposal, *parts, share)
        return AdamRobust(tables, space, proposal, *parts)
    score = replace(settings.score, range_max=lidar.range_max)
    tables = make_tables(grid, table_for(grid.resolution, settings.raycast), lidar.range_max)
    world = World(tables, space, used, step, settings.motion, score)
    sure = isinstance(proposal, LikelihoodGrid | Hybrid | MarkovGrid)
    drawn, averaged = powers(algorithm, sure, settings.weight_power)
    config = FilterConfig(settings.particles, weight_power=drawn, estimate_power=averaged)
    if algorithm == "mcl":
        return MCL(world, config)
    if algorithm == "mixture_mcl":
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
    drawn = isinstance(filter, AdamPlaces)
    belief = filter.proposal if isinstance(filter, AdamPlaces) else None
    if belief is None:
        belief = grid_belief(make_proposal("likelihood_grid", grid, lidar, settings), grid, settings.belief)  # type: ignore[arg-type]
    tables = make_tables(grid, settings.robust_raycast, lidar.range_max)
    return Watched(filter, belief, monitor(tables, lidar), drawn, head, estimate)
