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
from dsom_jax.filters.updates import FilterConfig
from dsom_jax.filters.world import World
from dsom_jax.lidar import LidarConfig
from dsom_jax.motion import OdometryMotion, omni_like
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.proposals.dsom import DSOMProposal, dsom
from dsom_jax.proposals.dual_features import DualFeaturesConfig, dual_features, with_episode
from dsom_jax.proposals.hybrid import Hybrid, HybridConfig
from dsom_jax.proposals.likelihood_grid import LikelihoodGrid, LikelihoodGridConfig, likelihood_grid
from dsom_jax.proposals.markov_grid import MarkovGrid, MarkovGridConfig
from dsom_jax.proposals.markov_network import MarkovNetwork, MarkovNetworkConfig
from dsom_jax.proposals.uniform import free_space
from dsom_jax.raycast import RaycastConfig, make_tables
from dsom_jax.sensor import BeamModel, LikelihoodField, ScoreModel, SensorModel
from dsom_jax.types import Filter, Motion, Proposal

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
PARTS = {
    "hybrid": ("likelihood_grid", "dsom"),
    "markov_grid": ("likelihood_grid",),
    "markov_dsom": ("likelihood_grid", "dsom"),
    "markov_hybrid": ("likelihood_grid", "dsom"),
}
EXACT = ("likelihood_grid", *PARTS)
"""Names of the proposals that hold the exact likelihood of a scan, or what all scans so far say."""
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


WEIGHT_POWER = 8.0
"""Power of Eq 15 in the ``_sharp`` methods."""


def sharp_powers(proposal: str, weight_power: float = WEIGHT_POWER) -> tuple[float, float]:
    """Powers of Eq 15 by which a ``_sharp`` method draws and averages, for the proposal of that name.

    Draws have to leave room for places that are only likely, an average has not: it goes by 16 where draws go by 8,
    and by 1, as printed, where they do (experiments/dsom/REPORT.md). With one of :data:`EXACT` draws are as printed and
    only the average is sharpened, by ``weight_power``: PM then is as good as sure, and what gathers sooner than PM
    arrives stays at a wrong place that looks alike.
    """
    return (1.0, weight_power) if proposal in EXACT else (weight_power, round(weight_power ** (4 / 3), 9))


def powers_of(method: str, weight_power: float = WEIGHT_POWER) -> tuple[float, float] | None:
    """Powers by which a method of :data:`METHODS` draws and averages; None for those that do not weigh by Eq 15."""
    if method in LEARNED or COMBINATIONS[method][0] == "adam_robust":
        return None
    algorithm, proposal = COMBINATIONS[method]
    return sharp_powers(proposal, weight_power) if algorithm.endswith("_sharp") else (1.0, 1.0)


@dataclass(frozen=True)
class Settings:
    """What all filters of a comparison share; ``range_max`` of the sensor models follows the lidar.

    The paper's filters are MCL, Mixture MCL and Alg 1.

    Attributes:
        particles: N.
        t_cut: T_cut of Alg 1.
        max_beams: beams used for weighing.
        seed: of what is random while a filter is built (the samples of Mixture MCL).
        motion, sensor, raycast: drive, observation model and expected ranges of the paper's filters; of a table on
            maps of coarse cells see :func:`table_for`.
        powers: of the weights by which ``_sharp`` filters draw and average, as if so many such scans had been seen; the
            others do both by the weights themselves, with which a particle elsewhere weighs half as much as one at
            the truth (experiments/REPORT.md). See :func:`sharp_powers`.
        grid: the likelihood grid.
        sharpness: exponent of DSOM's PM in the paper's filters (``experiments/dsom``).
        hybrid: weights of likelihood grid and network.
        robust, robust_motion, robust_sensor, robust_raycast: AdaM robust; its ``particles`` are those above.
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
    sensor: SensorModel = ScoreModel()
    raycast: RaycastConfig = RaycastConfig("table")
    grid: LikelihoodGridConfig = LikelihoodGridConfig()
    powers: tuple[float, float] = sharp_powers("dsom")
    sharpness: float = 3.0
    hybrid: HybridConfig = HybridConfig()
    robust: RobustConfig = RobustConfig()
    robust_motion: Motion = OdometryMotion(0.01, 0.01, 0.01, 0.01, 0.02, 0.015, slip=0.1, tail=0.4, tail_scale=4.0)
    robust_sensor: SensorModel = BeamModel(0.65, 0.05, 0.05, 0.25, sigma_hit=0.1, temper=0.2)
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
        checks.positive(self, "sharpness robust_sharpness memory_temper")


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
    robust_sensor=replace(_FURNISHED, temper=0.1),
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


SensorName = Literal["beam", "likelihood_field", "score"]
MotionName = Literal["differential", "omni"]


def with_sensor(settings: Settings, name: SensorName) -> Settings:
    """The settings with another observation model, for all filters.

    ``beam``: that of AdaM robust. ``likelihood_field``: nav2's default, as far from the walls as the beam model allows.
    ``score``: Eq 15, in AdaM robust to the power of 8, as if so many such scans had been seen.
    """
    beam = settings.robust_sensor
    if name == "beam":
        model: SensorModel = beam
    elif name == "likelihood_field":
        own = {n: getattr(beam, n) for n in ("sigma_hit", "temper") if hasattr(beam, n)}
        model = LikelihoodField(**own)
    else:
        model = ScoreModel(temper=WEIGHT_POWER)
    return replace(settings, sensor=model, robust_sensor=model)


def with_motion(settings: Settings, name: MotionName) -> Settings:
    """The settings with another model of the drive, as noisy as the one that they have."""
    if name == "differential":
        return settings
    both = {field: omni_like(getattr(settings, field)) for field in ("motion", "robust_motion")}
    return replace(settings, **both)  # type: ignore[arg-type]  # fields of one type


def within_reach(sensor: SensorModel, lidar: LidarConfig) -> SensorModel:
    """The model for readings of a lidar: its ``range_max``, where it has one, is the lidar's."""
    return replace(sensor, range_max=lidar.range_max) if hasattr(sensor, "range_max") else sensor  # type: ignore[type-var]


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
    drawn = isinstance(filter, AdamPlaces)
    belief = filter.proposal if isinstance(filter, AdamPlaces) else None
    if belief is None:
        belief = grid_belief(make_proposal("likelihood_grid", grid, lidar, settings), grid, settings.belief)  # type: ignore[arg-type]
    tables = make_tables(grid, settings.robust_raycast, lidar.range_max)
    return Watched(filter, belief, monitor(tables, lidar), drawn, head, estimate)
