"""The page of ``localize``: what its runs came to, and run 0 of every drive to look at."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dsom_jax.diagnosis.findings import Finding
from dsom_jax.judging.scores import Outcome, judged_by
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.plotting import save_figure
from dsom_jax.view.answers import Answers, answers, write_answers
from dsom_jax.view.page import readable, write_page
from dsom_jax.view.picture import trajectory_figure
from dsom_jax.view.story import DriveStory, Plan, Remark, Story

JUDGED = (
    ("converged", "of all starts found", "percent"),
    ("metres_median", "driven until found, median", "metres"),
    ("e_pos_m_median", "off at the end, median", "metres"),
    ("retention", "of the later updates still right", "percent"),
    ("false_confident", "of the updates sure and wrong", "percent"),
)
UNJUDGED = (("confident", "of the updates sure of an answer", "percent"), ("updates", "updates", "count"))


def write_view(
    folder: Path,
    outcomes: list[Outcome],
    grid: OccupancyGrid,
    lidar: LidarConfig,
    summary: dict[str, Any],
    findings: Sequence[Finding],
    notes: Sequence[str],
    settings: Any,
) -> tuple[DriveStory, ...]:
    """``answers.csv``, ``trajectory.png`` and ``report.html``, which shows the drives that are returned.

    ``settings`` are the arguments of the command line.
    The page names the ``findings`` by their severity, then the ``notes``. The outcomes keep the states of all updates
    (``montecarlo.run(..., keep=range(T))``).
    """
    said = [told(outcome, settings.method) for outcome in outcomes]
    story = _tell(outcomes, said, grid, lidar, summary, remarks(findings, notes), settings)
    write_answers(folder / "answers.csv", said)
    save_figure(trajectory_figure(story.plan, story.drives[0]), folder / "trajectory.png")
    write_page(folder / "report.html", story)
    return story.drives


def remarks(findings: Sequence[Finding], notes: Sequence[str]) -> tuple[Remark, ...]:
    """What the page has to say of map and log."""
    return (*(Remark(f.says, f.severity, f.fix) for f in findings), *(Remark(note) for note in notes))


def told(outcome: Outcome, method: str) -> Answers:
    """Answers of run 0 of a drive."""
    info = outcome.result.info
    return answers(outcome.drive.stamps, np.asarray(getattr(info, judged_by(method))), info, outcome.result.kept)


def _tell(
    outcomes: list[Outcome],
    said: list[Answers],
    grid: OccupancyGrid,
    lidar: LidarConfig,
    summary: dict[str, Any],
    findings: tuple[Remark, ...],
    settings: Any,
) -> Story:
    """The story of all drives."""
    place, log = Path(summary["map"]).name, Path(summary["log"]).name
    drives = tuple(
        _drive(f"segment {n}", outcome, a) for n, (outcome, a) in enumerate(zip(outcomes, said, strict=True), 1)
    )
    judged = "converged" in summary
    return Story(
        f"Finding the robot in {Path(place).stem}",
        _headline(summary),
        plan_of(grid, lidar, f"{place} · {log}"),
        drives,
        summary,
        JUDGED if judged else UNJUDGED,
        (_segments(summary),) if judged else (),
        findings,
        dataclasses.asdict(settings),
        caption=f"Run 1 of {summary['runs']} of each segment.",
    )


def plan_of(grid: OccupancyGrid, lidar: LidarConfig, name: str) -> Plan:
    """The map and the lidar as a page needs them."""
    occupied, free, origin = (np.asarray(part) for part in (grid.occupied, grid.free, grid.origin))
    return Plan(occupied, free, origin, grid.resolution, lidar.angles(), lidar.mount[:2], name)


def _headline(summary: dict[str, Any]) -> str:
    """What came out, in words."""
    if "converged" not in summary:
        sure = f"The filter was sure of its answer at {readable(summary['confident'], 'percent')} of"
        return f"{sure} {summary['updates']} updates. There is no reference to judge it by."
    starts = summary["experiments"]
    text = f"Started anywhere, the robot was found in {readable(summary['converged'], 'percent')} of {starts} runs"
    if summary["metres_median"] == summary["metres_median"]:  # none was found: not a number
        driven = summary["metres_median"]
        text += f", after {readable(driven, 'metres')} of driving (median)" if driven >= 0.1 else ", at once (median)"
    if "kidnap" in summary:
        text += f". Carried away unnoticed, it was found again in {readable(summary['kidnap']['converged'], 'percent')}"
    rates = [("the updates", summary["false_confident"])]
    if "kidnap" in summary:
        rates.append(("the updates after it was carried away", summary["kidnap"]["false_confident"]))
    fooled = [f"{readable(rate, 'percent')} of {where}" for where, rate in rates if rate > 0]
    return f"{text}. It was sure and wrong at {' and at '.join(fooled) if fooled else 'none of the updates'}."


def _drive(name: str, outcome: Outcome, said: Answers) -> DriveStory:
    episode = outcome.drive.episode
    return DriveStory(
        name, said.stamps, said.poses, said.p_lost, said.verdicts, np.asarray(episode.poses, float),
        np.asarray(episode.kidnapped), np.asarray(episode.ranges), said.particles, said.weights, said.hypotheses,
    )  # fmt: skip


def _segments(summary: dict[str, Any]) -> tuple[str, tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Table of the segments."""
    rows = tuple(
        (str(n), f"{part['start_stamp']:.1f} s",
         *(readable(part[name], "percent") for name in ("on_map", "converged", "strict_success")),
         readable(part["e_pos_m_median"], "metres"))
        for n, part in enumerate(summary["by_segment"], 1)
    )  # fmt: skip
    heads = ("segment", "starts at", "on the map", "found", "within 0.5 m at the end", "off at the end, median")
    return "Segments", heads, rows
