"""What a DSOM is: everything that must be known to rebuild it before its weights are read."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from dsom_jax import checks
from dsom_jax.lidar import LidarConfig


@dataclass(frozen=True)
class DSOMConfig:
    """Architecture and scale of a network.

    Attributes:
        width: channels of the first block, w of the paper's tables (64 there).
        headings: K, the number of orientations of PM.
        resolution: metres per cell of the maps and scan images it was trained on.
        encoder: ``polar`` (circular 1-D CNN over bearings, any lidar) or ``paper`` (2-D CNN on the scan image).
        paper_head: batch norm and ELU on the last layer too, as the authors do (floors the logits at -1).
        scan_size: cells along a side of the scan image of the ``paper`` encoder, 64 or 128.
        range_max: metres; longer ranges count as no return.
        channels: features of one heading bin of the ``polar`` encoder, so that D = K * channels.
        panorama: compare ``polar`` scans also with views that are ray-cast from every second cell of the map.
        radial_bins: radial basis functions that describe one range to the ``polar`` encoder.
        fov_min: the narrowest scan it was trained for, radians.
        reach_min: the shortest maximal range it was trained for, metres.
    """

    width: int = 32
    headings: int = 32
    resolution: float = 1 / 3
    encoder: Literal["polar", "paper"] = "polar"
    paper_head: bool = False
    scan_size: int = 64
    range_max: float = 10.0
    channels: int = 8
    panorama: bool = False
    radial_bins: int = 20
    fov_min: float = 2 * math.pi
    reach_min: float = 10.0

    def __post_init__(self) -> None:
        checks.count(self, "width headings channels")
        checks.count(self, "radial_bins", 2)
        if self.headings % 2:
            raise ValueError(checks.message(self, "headings", "give an even number"))
        checks.choice(self, "encoder", ("polar", "paper"))
        if self.encoder == "paper" and self.scan_size not in (64, 128):
            raise ValueError(f"scan_size = {self.scan_size}: 64 or 128, so that 4 x 4 cells reach the MLP")
        if self.panorama and self.encoder != "polar":
            raise ValueError("panorama needs encoder polar")
        checks.positive(self, "resolution range_max fov_min reach_min")

    @property
    def depth(self) -> int:
        """D, the length of one feature vector of Eq 3."""
        return 4 * self.width if self.encoder == "paper" else self.headings * self.channels

    @property
    def angular_bins(self) -> int:
        """Bearings that the polar encoder reads, four in each heading bin."""
        return 4 * self.headings

    def misfit(self, lidar: LidarConfig) -> str | None:
        """Why scans of ``lidar`` are not what the network was trained for, or None."""
        if less := lacking(lidar, self.fov_min, self.reach_min):
            return less
        if lidar.fov / lidar.beams > 4 * math.pi / self.headings:
            return f"{lidar.beams} beams are fewer than one in two of the {self.headings} headings"
        return None


def lacking(lidar: LidarConfig, fov_min: float, reach_min: float) -> str | None:
    """What scans of ``lidar`` lack of a field of view (radians) and a reach (metres) that were trained for, or None."""
    if lidar.fov < fov_min - 0.02:
        return f"field of view {math.degrees(lidar.fov):.0f} deg, trained for {math.degrees(fov_min):.0f} or more"
    if lidar.range_max < reach_min - 1e-3:
        return f"range_max {lidar.range_max:g} m, trained for {reach_min:g} m or more"
    return None
