"""Every number of the paper that this report stands beside, with where the paper says it.

R. Chen et al., "Deep Samplable Observation Model for Global Localization and Kidnapping", RA-L 2021. Figures give no
numbers; what was read off one is marked so and is good to a few per cent at best.
"""

from __future__ import annotations

from typing import NamedTuple


class Quoted(NamedTuple):
    """A number of the paper.

    Attributes:
        value: the number; errors in metres or radians, shares in [0, 1], times in seconds.
        source: table, figure or section.
        read_off: estimated from a figure, not printed.
    """

    value: float
    source: str
    read_off: bool = False


class Errors(NamedTuple):
    """One row of Table I or II: E_pos in metres and E_theta in radians, by phase."""

    global_e_pos: float
    global_e_theta: float
    kidnap_e_pos: float
    kidnap_e_theta: float

    def of(self, phase: str, which: str) -> float:
        """``which`` is ``e_pos`` or ``e_theta``."""
        return float(getattr(self, f"{phase}_{which}"))


T_CUT = {
    0.1: Errors(0.299, 0.017, 0.188, 0.031),
    0.3: Errors(0.190, 0.019, 0.150, 0.021),
    0.5: Errors(0.163, 0.018, 0.169, 0.018),
    0.7: Errors(0.155, 0.015, 0.286, 0.053),
    0.9: Errors(0.725, 0.023, 1.133, 0.547),
}
"""Table I: AdaM MCL with DSOM by T_cut, 200 particles."""

PARTICLES = {
    200: Errors(0.153, 0.022, 0.128, 0.022),
    500: Errors(0.088, 0.017, 0.089, 0.016),
    1000: Errors(0.060, 0.016, 0.072, 0.007),
}
"""Table II: AdaM MCL with DSOM by number of particles, T_cut 0.6."""

WITHIN_20 = {
    "global": {"adam_dsom": Quoted(0.82, "Fig 7", True), "best rival": Quoted(0.26, "Fig 7", True)},
    "kidnap": {"adam_dsom": Quoted(1.00, "Fig 7", True), "best rival": Quoted(0.35, "Fig 7", True)},
}
"""Share of the 600 experiments that converge within 20 updates."""

SECONDS = {
    "dsom": Quoted(0.02, "Sec V-A, one TITAN GPU of 12 GB"),
    "pf_net": Quoted(0.08, "Sec V-A, one TITAN GPU of 12 GB"),
    "pfrnn": Quoted(0.08, "Sec V-A, one TITAN GPU of 12 GB"),
}
"""Inference of one iteration."""

BASELINES = ("mcl", "mixture_mcl", "mixture_mcl_star", "pfrnn", "pf_net")
"""Sec V-A; Mixture MCL* cheats: its samples contain the test sequence."""
