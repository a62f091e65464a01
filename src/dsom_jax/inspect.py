"""``python -m dsom_jax.inspect``: what is in a log and a map, and what explains that they do not fit."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro

from dsom_jax import report
from dsom_jax.cli import parse
from dsom_jax.data import LogOptions, RawLog, Report, load_log, load_map
from dsom_jax.diagnosis.describe import describe_log, describe_map, messages_of
from dsom_jax.diagnosis.explain import explain
from dsom_jax.diagnosis.findings import Finding, ordered
from dsom_jax.diagnosis.symptoms import grey_is_free
from dsom_jax.errors import UserError, run_cli
from dsom_jax.occupancy import OccupancyGrid


@dataclass(frozen=True)
class InspectArgs:
    """Say what is in a log and a map, and find what is wrong with them: mount, signs, scales, clocks, frames."""

    log: tyro.conf.Positional[Path]
    """Whatever localize reads."""
    map: Path | None = None
    """The map that the log should fit; without one only scans and odometry are held against each other."""
    reference: Path | None = None
    """TUM trajectory of the base in the map frame; default: the log's own, where it has one."""
    json: Path | None = None
    """File for all of it: {"log", "map", "findings"}."""
    reading: tyro.conf.OmitArgPrefixes[LogOptions] = LogOptions()
    """How to read the log."""


def main() -> None:
    """Command line."""
    args = parse(InspectArgs, "python -m dsom_jax.inspect")
    if args.json is not None:
        report.output_folder(args.json.parent)
        if args.json.is_dir():
            raise UserError(f"--json {args.json}: is a folder; name a file")
    log = load_log(args.log, args.reading, reference=args.reference)
    notes = Report()
    grid = load_map(args.map, notes) if args.map else None
    result = inspect(log, args.log, grid, args.map, notes)
    if args.json is not None:
        report.write_json(args.json, result)
    print("\n".join(lines(result)))


def inspect(
    log: RawLog,
    log_path: Path,
    grid: OccupancyGrid | None = None,
    map_path: Path | None = None,
    notes: Report | None = None,
) -> dict[str, Any]:
    """What ``--json`` writes: "log" and "map" describe, "findings" judge, most important first."""
    told = explain(log, grid)
    found = [*told.findings, *(grey_is_free(map_path) if map_path else [])]
    described = describe_map(map_path, grid, notes.lines() if notes else []) if grid is not None and map_path else None
    return {
        "log": describe_log(log) | {"messages": messages_of(log_path)} | told.numbers(),
        "map": described, "findings": [asdict(f) for f in ordered(found)],
    }  # fmt: skip


def lines(result: dict[str, Any]) -> list[str]:
    """All of it for a person."""
    log = result["log"]
    shares, clock, odometry, mount = log["ranges"]["shares"], log["clock"], log["odometry"], log["mount"]
    out = [f"log {log['path']}"]
    out += [f"  {kind}: {count} messages" for kind, count in log["messages"].items()]
    out += [
        f"  {log['scans']} scans in {clock['duration_s']:.1f} s ({clock['rate_hz']:.2f} Hz, longest gap "
        f"{clock['longest_gap_s']:.2f} s, {clock['not_newer']} not newer than the one before)",
        f"  {log['beams']} beams, {log['fov_deg']:.1f} deg from {log['angle_min_deg']:.1f} deg on, "
        f"{log['range_min_m']:g} to {log['range_max_m']:g} m",
        "  readings: " + ", ".join(f"{share:.1%} {name.replace('_', ' ')}" for name, share in shares.items()),
        f"  lidar at ({mount['x_m']:.2f}, {mount['y_m']:.2f}) m, {mount['yaw_deg']:.1f} deg on the base"
        + (", upside down" if mount["upside_down"] else ""),
        f"  odometry: {odometry['travelled_m']:.1f} m, {odometry['turned_deg']:.0f} deg, largest step "
        f"{odometry['largest_step_m']:.2f} m and {odometry['largest_turn_deg']:.0f} deg, "
        f"{odometry['standing']:.0%} standing",
    ]
    if log["reference"]:
        out.append(f"  reference: {log['reference']['scans']:.0%} of the scans")
    out += [f"  {note}" for note in log["notes"]]
    if result["map"]:
        out += map_lines(result["map"])
    out += [f"  {key.replace('_', ' ')}: {_numbers(log[key])}" for key in log if key.startswith("scans_against")]
    out += [Finding(**finding).line() for finding in result["findings"]]
    return out + ([] if result["findings"] else ["nothing found that is wrong"])


def map_lines(described: dict[str, Any]) -> list[str]:
    """The map for a person."""
    (x, y), (rows, columns) = described["size_m"], described["cells"]
    shares = ", ".join(f"{share:.0%} {name}" for name, share in described["shares"].items())
    return [
        f"map {described['path']}",
        f"  {x:.1f} x {y:.1f} m, {columns} x {rows} cells of {described['resolution_m']:g} m, {shares}",
        *(f"  {note}" for note in described["notes"]),
    ]


def _numbers(found: dict[str, Any]) -> str:
    """The numbers of a search on one line."""
    return ", ".join(
        f"{key.replace('_', ' ')} {value:.3g}" if isinstance(value, float) else f"{key.replace('_', ' ')} {value}"
        for key, value in found.items()
        if key != "tried"
    )


if __name__ == "__main__":
    run_cli(main)
