"""What ``localize`` is asked for: its command line, what means nothing in it, and the filter that it names."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from dsom_jax import checkpoint
from dsom_jax.belief.watched import Watched
from dsom_jax.data import LogOptions
from dsom_jax.errors import UserError
from dsom_jax.filters.methods import make_filter, make_proposal, watch
from dsom_jax.filters.settings import DRAWN, REAL, sharp_powers, with_motion, with_sensor
from dsom_jax.judging.scores import judged_by
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.view.rerun_file import load_rerun


@dataclass(frozen=True)
class LocalizeArgs:
    """Cut a log into segments, start each without any prior, and tell how often the robot is found."""

    map: Path
    """ROS map_server YAML, a bag with /map, a DXF drawing, or a YAML with `drawing: FILE.dxf` and how to read it."""
    log: Path
    """CARMEN (.log, .clf, .gz), rosbag1, rosbag2, mcap, or Rawseeds (*-SICK_FRONT.csv, or its folder)."""
    out: Path
    """Folder for report.html, trajectory.png, summary.json, answers.csv and estimate.tum."""
    reference_on_plan: Path | None = None
    """TUM trajectory carried over to a floor plan that is locally wrong; judged besides, as on_plan in summary.json."""
    external: tuple[str, ...] = ()
    """NAME=FILE.tum: another localizer's trajectory, judged alike, as external in summary.json."""
    reference: Path | None = None
    """TUM trajectory of the base in the map frame; default: the log's own, where it has one."""
    reading: Annotated[LogOptions, tyro.conf.arg(name="")] = LogOptions()
    """What the log does not say, or says wrongly; topics and frames are those of bags."""
    method: Literal["adam_robust", "adam", "adam_sharp", "mcl", "mcl_sharp", "mixture_mcl", "mixture_mcl_sharp"] = (
        "adam_robust"
    )
    """Particle filter; `adam`, `mcl`, `mixture_mcl` weigh as the paper prints, `_sharp` by powers of Eq 15."""
    proposal: Literal["likelihood_grid", "dsom", "hybrid", "uniform", "dual_features"] = "likelihood_grid"
    """Where redrawn particles come from; `mcl` always draws uniformly."""
    checkpoint: Path | None = None
    """Folder of a trained network, for dsom and hybrid; default: the one in the repository."""
    map_kind: Literal["scanned", "drawn"] = "scanned"
    """A map made from scans, or a floor plan that shows walls only."""
    particles: int = 500
    """Particles per run."""
    runs: int = 100
    """Monte-Carlo runs of each segment."""
    segments: int = 8
    """Pieces of the log, each started anew."""
    steps_per_segment: int = 60
    """Updates in a segment; 0 cuts the log into contiguous pieces without rest."""
    update_min_d: float = 0.25
    """Metres driven between updates."""
    update_min_a: float = 0.2
    """Radians turned between updates."""
    sensor_model: Literal["beam", "likelihood_field", "score"] | None = None
    """What a scan says of a pose; default: `beam` for adam_robust, `score`, Eq 15 of the paper, for the others."""
    motion_model: Literal["differential", "omni"] = "differential"
    """Drive of the robot: `omni` also moves sideways (nav2's robot_model_type)."""
    memory: bool = True
    """Let adam_robust remember earlier scans on the likelihood grid; --no-memory judges every scan on its own."""
    live: bool = False
    """One run of each segment through a Localizer, update by update as on a robot; tells latencies."""
    kidnap: bool = False
    """Join each segment to the one half the log away, as an unnoticed kidnapping."""
    t_cut: float = 0.6
    """T_cut of Alg 1."""
    laser_max_range: float = 25.0
    """Metres; longer readings count as no return."""
    max_beams: int = 60
    """Beams used for weighing."""
    seed: int = 0
    """Seed of all randomness."""
    json: bool = False
    """Print summary.json instead of a table."""
    mcap: Path | None = None
    """FILE.mcap: besides, run 0 as a recording that Foxglove and ROS 2 play: map, scans, answers, particles."""
    rerun: Path | None = None
    """FILE.rrd: the same for the Rerun viewer; needs `pip install 'dsom-jax[rerun]'`."""


MANY = 1_000_000


def check(args: LocalizeArgs) -> None:
    """UserError for settings that mean nothing."""
    for name in ("particles", "runs", "segments", "max_beams", "laser_max_range"):
        if not getattr(args, name) > 0:
            raise UserError(f"--{name.replace('_', '-')} {getattr(args, name)}: give a positive number")
    for name, most in (("particles", MANY), ("runs", MANY), ("segments", MANY), ("seed", 2**32 - 1)):
        if getattr(args, name) > most:
            raise UserError(f"--{name} {getattr(args, name)}: give at most {most}")
    for name in ("update_min_d", "update_min_a", "seed"):
        if not getattr(args, name) >= 0:
            raise UserError(f"--{name.replace('_', '-')} {getattr(args, name)}: must not be negative")
    if args.steps_per_segment and args.steps_per_segment < 6:
        raise UserError(f"--steps-per-segment {args.steps_per_segment}: give at least 6, or 0 for the whole log")
    if not 0 < args.t_cut < 1:
        raise UserError(f"--t-cut {args.t_cut}: give a number between 0 and 1 (the paper uses 0.6)")
    check_network(args)
    check_recordings(args)
    if args.kidnap and args.segments < 2:
        raise UserError(f"--segments {args.segments}: --kidnap joins two segments, give at least 2")


def check_network(args: LocalizeArgs) -> None:
    """UserError if a network is needed and none there, or one is named and nothing draws from it."""
    if needs_network(args) and network_folder(args) is None:
        raise UserError(f"--proposal {args.proposal}: give --checkpoint, the folder of a trained network")
    if args.checkpoint and not needs_network(args):
        chosen = f"--method {args.method}" if args.method.startswith("mcl") else f"--proposal {args.proposal}"
        fix = "leave it out, or give --proposal dsom or hybrid and a --method other than mcl"
        raise UserError(f"--checkpoint {args.checkpoint}: has no use with {chosen}; {fix}")


def check_recordings(args: LocalizeArgs) -> None:
    """UserError if a recording is to be a folder, or a file that its player would not take, or cannot be made."""
    for option, path, suffix in (("--mcap", args.mcap, ".mcap"), ("--rerun", args.rerun, ".rrd")):
        if path is not None and path.suffix.lower() != suffix:
            raise UserError(f"{option} {path}: name a file that ends in {suffix}")
        if path is not None and path.is_dir():
            raise UserError(f"{option} {path}: is a folder; name a file")
    if args.rerun:
        load_rerun()


def drawn_from(args: LocalizeArgs) -> str:
    """Name of the proposal that the filter draws from, whatever the arguments name: MCL's is uniform."""
    return "uniform" if args.method.startswith("mcl") else args.proposal


def remembers(args: LocalizeArgs) -> bool:
    """Whether the filter remembers earlier scans on the likelihood grid."""
    return args.memory and args.method == "adam_robust" and args.proposal == "likelihood_grid"


def needs_network(args: LocalizeArgs) -> bool:
    """Whether the filter draws from a trained network."""
    return drawn_from(args) in ("dsom", "hybrid")


def network_folder(args: LocalizeArgs) -> Path | None:
    """The checkpoint that is named, else the one that comes with the repository."""
    return args.checkpoint or checkpoint.shipped()


def load_network(args: LocalizeArgs, lidar: LidarConfig) -> Any:
    """The trained network that the arguments ask for, None if nothing draws from one."""
    folder = network_folder(args) if needs_network(args) else None
    return None if folder is None else checkpoint.load(folder, lidar=lidar)


def build(args: LocalizeArgs, grid: OccupancyGrid, lidar: LidarConfig, network: Any = None) -> Watched:
    """The filter that the arguments ask for, with a verdict on its answers."""
    kind = DRAWN if args.map_kind == "drawn" else REAL
    own = ("particles", "t_cut", "max_beams", "seed", "memory")
    settings = replace(kind, **{name: getattr(args, name) for name in own}, powers=sharp_powers(drawn_from(args)))
    if args.sensor_model:
        settings = with_sensor(settings, args.sensor_model)
    settings = with_motion(settings, args.motion_model)
    proposal = make_proposal(drawn_from(args), grid, lidar, settings, network)
    filter = make_filter(args.method, proposal, grid, lidar, settings)
    return watch(filter, grid, lidar, settings, judged_by(args.method))
