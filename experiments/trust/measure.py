"""How often is an answer called localized, and is it then right? Real and spoilt logs, wrong maps, equal places.

    python experiments/trust/measure.py --only clean half wrong --runs 10

Every case is localized with a verdict (``adam_robust`` on the belief over the grid, 500 particles, 8 segments of 60
updates); rows go to ``results.json``, one for each case, and are retained when the series goes on; ``MEASURED.md``
beside it is their table. The row ``all`` says how good ``p_lost`` is over every answer of every case, and over those of
real logs alone.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from spoilers import (
    Spoiler,
    crowd,
    glass,
    increment_times,
    mirrored,
    other_way,
    ranges_times,
    turned,
    upside_down,
)
from worlds import LIDARS, building, fourfold, twofold

from dsom_jax.belief.verdict import Verdict
from dsom_jax.cli import parse
from dsom_jax.data import RawLog, load_log, load_map
from dsom_jax.data.cut import segment_indices, splice, to_episode, without_repeats
from dsom_jax.data.log import limited
from dsom_jax.episode import Episode
from dsom_jax.errors import run_cli
from dsom_jax.filters.methods import make_filter, make_proposal, watch
from dsom_jax.filters.settings import DRAWN, REAL, Settings
from dsom_jax.judging.metrics import ANGLE, HOLD, POSITION, first_streak, pose_error
from dsom_jax.judging.trust import auroc, ece
from dsom_jax.lidar import LidarConfig
from dsom_jax.montecarlo import run, run_keys
from dsom_jax.occupancy import OccupancyGrid, cell_index, lookup
from dsom_jax.report import write_json, write_text
from dsom_jax.run_folder import commit
from dsom_jax.simulate.drive import DriveConfig, make_synthetic

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Args:
    """Measure verdicts."""

    data: Path = Path(os.environ.get("DSOM_DATA") or HERE.parents[2] / "shared" / "data")
    """Folder that holds a folder for each log."""
    out: Path = HERE / "results.json"
    """File of the rows."""
    only: tuple[str, ...] = ()
    """Groups: clean, kidnapped, half, plan, wrong, fault, crowd, glass, symmetric; default: all."""
    runs: int = 10
    """Runs of each segment."""
    segments: int = 8
    """Segments of each log."""
    force: bool = False
    """Measure again what has a row."""


class Words:
    """``p_lost`` and whether the answer was wrong, of every answer, in a file beside the rows."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.said = dict(np.load(path)) if path.exists() else {}

    def add(self, name: str, said: np.ndarray) -> dict[str, Any]:
        """Keep those of a case (n, 2), and say how good they are over all cases."""
        self.said[name] = said.astype(np.float16)
        np.savez_compressed(self.path, **self.said)
        return {
            scope: {"auroc": auroc(p, wrong > 0), "ece": ece(p, wrong > 0), "answers": len(p)}
            for scope, names in (("everything", self.said), ("real", [n for n in self.said if "symmetric" not in n]))
            if names
            for p, wrong in [np.concatenate([self.said[n] for n in names]).astype(np.float64).T]
        }


class Case(NamedTuple):
    """What a filter believes in, and the drives."""

    group: str
    name: str
    grid: OccupancyGrid
    lidar: LidarConfig
    episodes: list[Episode]
    settings: Settings


FAULTS: dict[str, Spoiler] = {
    "turned 180": turned(180),
    "turned 90": turned(90),
    "turned 10": turned(10),
    "mirrored": mirrored,
    "upside down": upside_down,
    "ranges 0.9": ranges_times(0.9),
    "ranges 1.1": ranges_times(1.1),
    "increment 0.97": increment_times(0.97),
    "increment 1.03": increment_times(1.03),
    "yaw sign": other_way,
}


def main() -> None:
    """Command line."""
    args = parse(Args, "python experiments/trust/measure.py")
    rows = json.loads(args.out.read_text()) if args.out.exists() else {}
    words = Words(args.out.with_suffix(".npz"))
    for case in every(args):
        name = f"{case.group}: {case.name}"
        if (args.only and case.group not in args.only) or (name in rows and not args.force):
            continue
        began = time.perf_counter()
        row, said = measure(case, args.runs)
        rows[name] = row | {"runs": args.runs, "tree": commit()[:7]}
        rows["all"] = words.add(name, said)
        print(f"{name:44}", {k: v for k, v in rows[name].items() if v is not None},
              f"{time.perf_counter() - began:.0f} s", flush=True)  # fmt: skip
        write_json(args.out, rows)
        write_text(args.out.with_name("MEASURED.md"), table(rows))


COLUMNS = {
    "wrong": "wrong", "certain": "localized", "false_confident": "false-confident",
    "certain_when_found": "localized after convergence", "certain_on_map": "localized on mapped ground",
    "left_in_2": "left within 2 updates of a kidnapping", "strict": "strict", "even": "equal places equal",
}  # fmt: skip
"""Shares of a row, and what they are called in the table."""


def table(rows: dict[str, Any]) -> str:
    """Markdown of all rows."""
    lines = ["# Verdicts, measured", "", "Written by `python experiments/trust/measure.py`; do not edit.", ""]
    for scope, good in rows.get("all", {}).items():
        numbers = f"AUROC {good['auroc']:.3f}, ECE {good['ece']:.3f}"
        lines.append(f"- `p_lost` over {scope}, {good['answers']} answers: {numbers}")
    heads = ("case", "tree", "runs", *COLUMNS.values(), "first localized", "error m")
    lines += ["", "In percent; `first localized` is a median of updates, `tree` the commit that was measured."]
    lines += ["", "| " + " | ".join(heads) + " |"]
    lines.append("| --- |" + " ---: |" * (len(COLUMNS) + 4))
    for name, row in rows.items():
        if name != "all":
            shares = [f"{100 * row[c]:.1f}" if row[c] is not None else "" for c in COLUMNS]
            rest = ["" if row[c] is None else f"{row[c]:.{n}f}" for c, n in (("first_localized", 1), ("error", 3))]
            lines.append(f"| {name} | {row['tree']} | {row['runs']} | " + " | ".join([*shares, *rest]) + " |")
    return "\n".join(lines) + "\n"


def every(args: Args) -> Iterator[Case]:
    """All cases, logs read when their turn comes."""

    def case(
        group: str, name: str, place: str, source: str, spoil: Spoiler | None = None, kidnap: bool = False
    ) -> Case:
        folder = args.data / source
        log = limited(load_log(folder / "log.clf.gz", reference=folder / "reference.tum"), 25.0)
        log = spoil(log) if spoil else log
        settings = DRAWN if "plan" in place or "walls" in place else REAL
        episodes = cut(log, args.segments, kidnap)
        return Case(group, name, load_map(map_of(args.data, place)), log.lidar, episodes, settings)

    wanted = args.only or ("clean", "kidnapped", "half", "plan", "wrong", "fault", "crowd", "glass", "symmetric")
    logs = ("intel", "freiburg-079", "freiburg-101", "edmonton")
    if "clean" in wanted:
        yield from (case("clean", log, log, log) for log in logs)
    if "kidnapped" in wanted:
        yield from (case("kidnapped", log, log, log, kidnap=True) for log in logs[:2])
    if "half" in wanted:
        yield from (case("half", log, log, log) for log in ("intel-half", "freiburg-079-half"))
    if "plan" in wanted:
        yield case("plan", "freiburg-079", "freiburg-079-walls-only", "freiburg-079")
    if "wrong" in wanted:
        for other in (*logs[1:], "upo_45", "elderly_center", "centre_sportif", "uva_lab", "willow"):
            yield case("wrong", f"intel on {other}", other, "intel")
        yield from (case("wrong", f"{log} on intel", "intel", log) for log in logs[1:])
    if "fault" in wanted:
        yield from (case("fault", f"{log} {name}", log, log, f) for log in logs[:2] for name, f in FAULTS.items())
    if "crowd" in wanted:
        for share in (0.4, 0.6):
            yield from (case("crowd", f"{log} {share}", log, log, crowd(share)) for log in logs[:2])
    if "glass" in wanted:
        yield from (case("glass", log, log, log, glass(0.5)) for log in logs[:2])
    if "symmetric" in wanted:
        yield from (symmetric(seed) for seed in range(10))


def map_of(data: Path, place: str) -> Path:
    """The yaml of a map with or without a log."""
    return data / place / "map.yaml" if (data / place).is_dir() else data / "maps" / f"{place}.yaml"


def cut(log: RawLog, segments: int, kidnap: bool) -> list[Episode]:
    """Segments of 60 updates; with ``kidnap`` each is followed by the one half the log further."""
    pieces = [to_episode(log, rows) for rows in without_repeats(segment_indices(log, segments, 60))]
    if not kidnap:
        return pieces
    others = pieces[len(pieces) // 2 :] + pieces[: len(pieces) // 2]
    return [splice(a, b) for a, b in zip(pieces, others, strict=True)]


def symmetric(seed: int) -> Case:
    """A drive through a building that looks the same after half a turn, or after a quarter."""
    from learn import SIMULATED

    make, name = ((twofold, "two-fold"), (fourfold, "four-fold"))[seed % 2]
    grid, lidar = make(building(900_000 + seed)), LIDARS[seed // 2 % 2]
    drive = DriveConfig(updates=(60,), update_min_d=0.3, obstacles=0, removed=0, lidar=lidar)
    _, episode = make_synthetic(900_000 + seed, grid, drive)
    return Case("symmetric", f"{name} {seed}", grid, lidar, [episode], SIMULATED)


def measure(case: Case, runs: int) -> tuple[dict[str, Any], np.ndarray]:
    """The row of a case, and ``p_lost`` beside whether the answer was wrong (n, 2)."""
    proposal = make_proposal("likelihood_grid", case.grid, case.lidar, case.settings)
    filter = make_filter("adam_robust", proposal, case.grid, case.lidar, case.settings)
    filter = watch(filter, case.grid, case.lidar, case.settings)
    judged = [judge(case, n, run(filter, e, run_keys(0, n, runs)).info, e) for n, e in enumerate(case.episodes)]
    pooled = {name: [part for j in judged if (part := j[name]) is not None] for name in judged[0]}
    said = np.stack([np.concatenate(pooled.pop("p_lost")), np.concatenate(pooled["wrong"])], -1)
    values = {name: np.concatenate(parts) if parts else np.empty(0) for name, parts in pooled.items()}
    row = {name: round(float(v.mean()), 4) if v.size else None for name, v in values.items()}
    row["first_localized"] = round(float(np.median(values["first_localized"])), 1)
    return row, said


def judge(case: Case, number: int, info: Any, episode: Episode) -> dict[str, np.ndarray | None]:
    """What an episode adds to each mean of the row."""
    e_pos, e_theta = (np.asarray(e) for e in pose_error(info.cluster, episode.poses))
    wrong = (e_pos > POSITION) | (e_theta > ANGLE)
    verdict, p = np.asarray(info.verdict), np.asarray(info.p_lost)
    sure = verdict == Verdict.LOCALIZED
    known = ~np.isnan(e_pos)
    first = np.where(sure.any(1), sure.argmax(1), sure.shape[1]).astype(float)
    converged = first_streak(~wrong, known, HOLD)[1]
    found = (converged >= 0)[:, None] & (np.arange(sure.shape[1]) > converged[:, None])
    i, j = cell_index(case.grid, episode.poses)
    free = np.broadcast_to(np.asarray(lookup(case.grid.free, i, j, outside=False)), sure.shape)
    moved = np.flatnonzero(np.asarray(episode.kidnapped))
    left = [(~sure[:, t : t + 3]).any(1) for t in moved if t > 0]
    weights = np.sort(np.asarray(info.hypotheses.weights), -1)[..., ::-1]
    fold = {"two": 2, "fou": 4}.get(case.name[:3])
    even = None
    if fold:
        even = (weights[..., 0] < 2 * weights[..., fold - 1]).ravel()
    return {
        "wrong": wrong[known],
        "certain": sure[known],
        "false_confident": (sure & wrong)[known],
        "first_localized": first,
        "certain_when_found": sure[known & found],
        "certain_on_map": sure[known & free],
        "p_lost": p[known],
        "p_lost_wrong": p[known & wrong] if (known & wrong).any() else None,
        "p_lost_right": p[known & ~wrong] if (known & ~wrong).any() else None,
        "left_in_2": np.concatenate(left) if left else None,
        "strict": (e_pos[:, -1] < 0.5) & (e_theta[:, -1] < np.radians(5)),
        "error": np.median(e_pos[known & ~wrong])[None] if (known & ~wrong).any() else None,
        "even": even,
    }


if __name__ == "__main__":
    run_cli(main)
