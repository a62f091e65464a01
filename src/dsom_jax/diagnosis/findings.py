"""A finding: what is wrong with a log or a map, the numbers that say so, and the line that mends it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")

CODES = (
    "odometry_frozen", "clock_offset", "odometry_jump", "scan_mirrored", "upside_down", "map_mirrored",
    "odometry_yaw_sign", "scan_turned", "ranges_scaled", "map_scaled", "angle_increment", "odometry_scaled",
    "wrong_map", "reference_frame", "unknown_is_free", "no_return_code", "self_hits", "beams_vary", "odd_stamps",
    "not_judged",
)  # fmt: skip
"""In the order in which one explains the next: of two errors the earlier is the cause of the later."""


@dataclass(frozen=True)
class Finding:
    """One thing that is odd.

    Attributes:
        code: its kind, one of ``CODES``.
        severity: error: answers will be wrong; warning: they get worse; note: worth knowing.
        says: what was found, with the numbers.
        fix: an option of the command line, a line of yaml, or what to do.
    """

    code: str
    severity: Severity
    says: str
    fix: str

    def __post_init__(self) -> None:
        if self.code not in CODES or self.severity not in SEVERITIES:
            raise ValueError(f"Finding: code = {self.code!r}, severity = {self.severity!r}: no such kind")

    def line(self) -> str:
        """One line for a person."""
        return f"{self.severity}: {self.code}: {self.says}; {self.fix}"


def ordered(findings: Iterable[Finding]) -> list[Finding]:
    """Errors first, causes before what they cause; of each code the most severe alone."""
    first: dict[str, Finding] = {}
    for finding in sorted(findings, key=lambda f: (SEVERITIES.index(f.severity), CODES.index(f.code))):
        first.setdefault(finding.code, finding)
    return list(first.values())
