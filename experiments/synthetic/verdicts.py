"""What the runs say of each claim of the paper: holds, holds in part, does not hold here. Computed, not typed.

A claim is evidence: numbers with intervals, on the side that the claim says or not (:mod:`.judging.statistics`).
Intervals and tests are over sequences; six are few, and what they cannot decide is called undecided.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import comparison
import cost
import multimodal
import numpy as np
import paper
import particles
import retention
from lab import Everything

from dsom_jax.judging.run_table import RunTable, join, paired
from dsom_jax.judging.statistics import RESAMPLES, Decision, Evidence, decide, evidence, paired_evidence

OURS = "adam_dsom"
PHASES = comparison.PHASES
NAMES = {"global": "global", "kidnap": "kidnapping"}
Claim = tuple[str, list[Evidence]]


def verdicts(everything: Everything) -> list[Decision]:
    """A decision on every claim for which there are results."""
    return [decide(text, found) for text, found in (claim(everything) for claim in CLAIMS) if found]


def runs_of(everything: Everything) -> RunTable | None:
    """The runs of the comparison that all its methods have."""
    results = everything.get(comparison.NAME, {})
    return shared([entry["runs"] for entry in results.values()]) if results else None


def shared(tables: Sequence[RunTable]) -> RunTable:
    """The runs that all of ``tables`` have: those of the same keys, whatever numbers of runs were asked for."""
    count = min(int(side.run.max()) for side in tables)
    return join([side.rows(side.run <= count) for side in tables])


def compare(
    everything: Everything, others: Sequence[str], make: Callable[[str, RunTable, RunTable], Evidence], ours: str = OURS
) -> list[Evidence]:
    """Evidence about ``ours`` against each of ``others`` in both phases, where both were run."""
    runs = runs_of(everything)
    if runs is None:
        return []
    have = set(runs.method.tolist())
    return [
        make(f"{ours} - {other}, {NAMES[phase]}", *paired(runs, ours, other, phase))
        for phase in PHASES
        for other in others
        if {ours, other} <= have
    ]


def converged(what: str, a: RunTable, b: RunTable) -> Evidence:
    """That a converges more often."""
    return paired_evidence(f"share converged, {what}", a.converged, b.converged, a.sequence, "greater")


def early(what: str, a: RunTable, b: RunTable) -> Evidence:
    """That a converges within 20 updates more often; runs that never do count."""
    ours, theirs = (side.converged & (side.steps <= 20) for side in (a, b))
    return paired_evidence(f"share converged within 20 updates, {what}", ours, theirs, a.sequence, "greater")


def nearer(what: str, a: RunTable, b: RunTable) -> Evidence:
    """That a's final E_pos is smaller, over all runs."""
    return paired_evidence(f"final E_pos [m], {what}", a.e_pos_m, b.e_pos_m, a.sequence)


def accuracy(everything: Everything) -> Claim:
    """Abstract, Sec V-C, Fig 6."""
    text = "AdaM MCL + DSOM estimates more accurately than MCL, Mixture MCL, Mixture MCL*, PFRNN and PF-Net (Fig 6)"
    return text, compare(everything, paper.BASELINES, nearer)


def converging_rate(everything: Everything) -> Claim:
    """Sec V-C."""
    text = "AdaM MCL + DSOM converges more often than these baselines (Fig 7)"
    return text, compare(everything, paper.BASELINES, converged)


def converging_speed(everything: Everything) -> Claim:
    """Sec V-C."""
    text = "AdaM MCL + DSOM converges in fewer steps than these baselines (Fig 7)"
    return text, compare(everything, paper.BASELINES, early)


def early_share(everything: Everything) -> Claim:
    """Fig 7, the numbers."""
    runs, found = runs_of(everything), []
    if runs is not None and OURS in runs.method:
        for phase in PHASES:
            side = runs.rows((runs.method == OURS) & (runs.phase == phase))
            soon, theirs = (side.converged & (side.steps <= 20)).astype(float), paper.WITHIN_20[phase][OURS].value
            # What was read off a figure is good to a few per cent.
            what = f"share converged within 20 updates, {NAMES[phase]}"
            found.append(evidence(what, soon, side.sequence, "greater", theirs - 0.03))
    return "Within 20 updates converge about 82 % (global) and 100 % (kidnapping), read off Fig 7, less 3 %", found


def filter_matters(everything: Everything) -> Claim:
    """Sec V-B, ablation."""
    text = "AdaM MCL converges faster and estimates better than Mixture MCL with the same DSOM (Fig 5)"
    return text, [piece for make in (early, nearer) for piece in compare(everything, ("mixture_mcl_dsom",), make)]


def generalizes(everything: Everything) -> Claim:
    """Sec V-B: as good as a model that has seen the test sequence, so it is no worse here."""
    text = "Mixture MCL with DSOM, which never saw the test maps, is no worse than Mixture MCL*, which saw the sequence"

    def no_worse(what: str, a: RunTable, b: RunTable) -> Evidence:
        return paired_evidence(f"share converged, {what}", a.converged, b.converged, a.sequence, "greater", -0.05)

    return text, compare(everything, ("mixture_mcl_star",), no_worse, "mixture_mcl_dsom")


def learned_filters(everything: Everything) -> Claim:
    """Sec II: 'doubtful whether these methods are able to cope with kidnapping'."""
    runs, found = runs_of(everything), []
    for name in ("pf_net", "pfrnn") if runs is not None else ():
        if runs is not None and name in runs.method:
            side = runs.rows((runs.method == name) & (runs.phase == "kidnap"))
            what = f"share recovered after kidnapping, {name}"
            found.append(evidence(what, side.converged, side.sequence, "less", 0.05))
    return "PF-Net and PFRNN cannot cope with kidnapping (Sec II: fewer than 5 % recover)", found


def accuracy_numbers(everything: Everything) -> Claim:
    """Table II, value by value."""
    found = []
    for count, entry in particles.by_count(everything).items() if particles.NAME in everything else ():
        runs = entry["runs"]
        for phase in PHASES:
            side = runs.rows((runs.phase == phase) & runs.converged)
            for which, column, unit in (("e_pos", side.e_pos_m, "m"), ("e_theta", side.e_theta_rad, "rad")):
                what = f"mean {which} [{unit}], {count} particles, {NAMES[phase]}"
                found.append(evidence(what, column, side.sequence, "less", paper.PARTICLES[count].of(phase, which)))
    return "Errors with 200, 500 and 1000 particles are no larger than in Table II", found


def more_particles(everything: Everything) -> Claim:
    """Table II, its trend."""
    by_count = particles.by_count(everything) if particles.NAME in everything else {}
    found = []
    for few, many in pairwise(sorted(by_count)):
        both = shared([by_count[n]["runs"]._replace(method=np.full(len(by_count[n]["runs"].run), str(n)))
                       for n in (few, many)])  # fmt: skip
        for phase in PHASES:
            a, b = paired(both, str(many), str(few), phase)
            kept = a.converged & b.converged
            what = f"final E_pos [m], {many} - {few} particles, {NAMES[phase]}"
            found.append(paired_evidence(what, a.e_pos_m[kept], b.e_pos_m[kept], a.sequence[kept]))
    return "More particles give smaller errors (Table II)", found


def insensitive(everything: Everything) -> Claim:
    """Sec V-B: 'not sensitive to parameter settings'; our spread against the paper's own."""
    by_cut = everything.get(retention.NAME, {}).get(OURS, {}).get("by_t_cut", {})
    cuts = [cut for cut in by_cut if float(cut) in paper.T_CUT]
    found = []
    for phase in PHASES if len(cuts) > 1 else ():
        sides = [by_cut[cut]["runs"] for cut in cuts]
        sides = [side.rows((side.phase == phase) & side.converged) for side in sides]
        theirs = [paper.T_CUT[float(cut)].of(phase, "e_pos") for cut in cuts]
        what = f"largest - smallest mean E_pos [m] over T_cut {cuts[0]} to {cuts[-1]}, {NAMES[phase]}"
        found.append(Evidence(what, *spread(sides), wanted="less", bound=max(theirs) - min(theirs)))
    return "The error depends on T_cut no more than in Table I, whose spread is the bound", found


def spread(sides: list[RunTable]) -> tuple[float, float, float]:
    """Largest less smallest mean E_pos of several settings, with its interval over draws of sequences.

    Draws of sequences in which a setting has no run are left out.
    """
    names = np.unique(np.concatenate([side.sequence for side in sides]))
    where = [np.searchsorted(names, side.sequence) for side in sides]
    sums = np.array([np.bincount(n, side.e_pos_m, len(names)) for n, side in zip(where, sides, strict=True)])
    counts = np.array([np.bincount(n, minlength=len(names)) for n in where])

    def ptp(picked: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            return np.ptp(sums[:, picked].sum(-1) / counts[:, picked].sum(-1), axis=0)

    draws = np.random.default_rng(0).integers(len(names), size=(RESAMPLES, len(names)))
    low, high = np.nanpercentile(ptp(draws), [2.5, 97.5])
    return float(ptp(np.arange(len(names)))), float(low), float(high)


def many_peaks(everything: Everything) -> Claim:
    """Sec III-C, V-B, Fig 3."""
    results, found = everything.get(multimodal.NAME, {}), []
    orders = [results[name]["dsom"] | {"order": results[name]["order"]} for name in results if name != "scenes"]
    for few, many in pairwise(orders):
        a, b = (np.array(side["peaks"], float) for side in (many, few))
        what = f"peaks of PM, {many['order']} - {few['order']} right poses"
        found.append(paired_evidence(what, a, b, np.array(many["world"]), "greater"))
    for side in orders:
        for key, what in (("exact", "exactly {} peaks"), ("all_found", "probability at all {} right poses")):
            low, high = side[f"{key}_ci95"]
            share = "share of scans with " + what.format(side["order"])
            found.append(Evidence(share, side[key], low, high, "greater", 0.9))
    return (
        "PM has as many peaks as there are right poses, the true one among them (Fig 3; here in 9 scans of 10)",
        found,
    )


def quick(everything: Everything) -> Claim:
    """Sec V-A."""
    times = everything.get(cost.NAME, {}).get("update", {}).get("times", {})
    found = []
    for other in ("pf_net", "pfrnn") if OURS in times else ():
        low, middle, high = (
            1e3 * (cost.seconds(times[OURS], mine) - cost.seconds(times[other], its))
            for mine, its in (("low_s", "high_s"), ("median_s", "median_s"), ("high_s", "low_s"))
        )
        found.append(Evidence(f"update [ms, between quartiles], {OURS} - {other}", middle, low, high))
    return "An update with DSOM is quicker than one of PF-Net or PFRNN (Sec V-A: 0.02 s against 0.08 s)", found


CLAIMS: tuple[Callable[[Everything], Claim], ...] = (
    many_peaks, generalizes, filter_matters, accuracy, converging_rate, converging_speed, early_share,
    accuracy_numbers, more_particles, insensitive, learned_filters, quick,
)  # fmt: skip


def section(everything: Everything) -> str:
    """The verdicts in brief, then the evidence of each."""
    found = verdicts(everything)
    lines = [f"| {v.claim} | **{v.outcome}** | {_counts(v)} |" for v in found]
    blocks = [
        "\n".join(["| claim of the paper | here | evidence for, against, undecided |", "| --- | --- | --- |", *lines])
    ]
    blocks += [f"**{v.claim}**: {v.outcome}.\n\n" + "\n".join(f"- {piece}" for piece in v.evidence) for v in found]
    return "\n\n".join([TEXT, *blocks])


def _counts(verdict: Decision) -> str:
    states = [piece.status() for piece in verdict.evidence]
    return ", ".join(str(states.count(state)) for state in ("supports", "contradicts", "undecided"))


TEXT = """\
*Holds*: all evidence supports the claim, each piece on its own; *in part*: some supports, some contradicts; *does not
hold here*: some contradicts and none supports; *undecided*: nothing contradicts, and not all could be shown.
Differences are of the same sequences and seeds, run by run (of peaks: of the same buildings). Intervals are 95 %
bootstrap over sequences or buildings, with all their runs. A piece counts as decided if its interval lies on one side
of the bound and an exact sign-flip test over the sequences agrees (p over drives); six sequences must all agree for
that. "No worse" means by less than 5 points; the bounds of 9 scans in 10 and of 5 % are ours."""
