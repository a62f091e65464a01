"""What all filters of a comparison share, and the two sets that real maps start from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from dsom_jax import checks
from dsom_jax.belief.grid_memory import GridBeliefConfig
from dsom_jax.filters.adam_robust import RobustConfig
from dsom_jax.lidar import LidarConfig
from dsom_jax.motion import OdometryMotion, omni_like
from dsom_jax.proposals.hybrid import HybridConfig
from dsom_jax.proposals.likelihood_grid import LikelihoodGridConfig
from dsom_jax.proposals.markov_grid import MarkovGridConfig
from dsom_jax.proposals.markov_network import MarkovNetworkConfig
from dsom_jax.raycast import RaycastConfig
from dsom_jax.sensor import BeamModel, LikelihoodField, ScoreModel, SensorModel
from dsom_jax.types import Motion

PARTS = {
    "hybrid": ("likelihood_grid", "dsom"),
    "markov_grid": ("likelihood_grid",),
    "markov_dsom": ("likelihood_grid", "dsom"),
    "markov_hybrid": ("likelihood_grid", "dsom"),
}
EXACT = ("likelihood_grid", *PARTS)
"""Names of the proposals that hold the exact likelihood of a scan, or what all scans so far say."""
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
    robust_raycast=RaycastConfig("exact", max_skip=127, wedges=8, surface=_SCANNED),
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


_COARSE = 0.2
"""Metres per cell above which the walls seen from its middle are not those seen from its corners."""


def table_for(resolution: float, config: RaycastConfig) -> RaycastConfig:
    """Coarse cells have four viewpoints, in half as many directions (``experiments/perf/raycast.py``)."""
    if config.method != "table" or resolution <= _COARSE:
        return config
    return replace(config, viewpoints=2 * config.viewpoints, angles=config.angles // 2)
