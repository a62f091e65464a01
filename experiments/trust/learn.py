"""Trim the tolerances of ``p_lost`` on simulated drives alone, and write the file that the package ships.

    python experiments/trust/learn.py --drives 160 --out src/dsom_jax/belief/learnt.py

Drives in which something is wrong (``worlds.py``) are localized; every update of every run gives the signs that the
monitor saw and whether the answer was more than 2 m or 10 deg off. ``PRIOR`` says what each sign should mean; the
likelihood of the labels moves the tolerances from there by some tens of per cent (a pull of ``ridge`` on their
logarithms), but for that of ``crab``, which is an error of the heading itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize
from worlds import Case, cases

from dsom_jax.belief.monitor import Signs
from dsom_jax.belief.verdict import CERTAIN, Head, p_lost
from dsom_jax.cli import parse
from dsom_jax.errors import run_cli
from dsom_jax.filters.methods import make_filter, make_proposal, watch
from dsom_jax.filters.settings import REAL, Settings
from dsom_jax.judging.metrics import ANGLE, POSITION, pose_error
from dsom_jax.judging.trust import auroc, ece
from dsom_jax.montecarlo import run, run_keys
from dsom_jax.types import Array

PRIOR = {
    "miss": 0.7, "long": 0.3, "miss_now": 1.2, "long_now": 0.8, "unknown": 0.9, "blind": 2.0, "crab": 0.175,
    "backward": 1.0, "stretch": 0.6, "slide": 0.5, "turn": 0.25, "jump": 1.3, "fresh": 1.0,
}  # fmt: skip
HEADER = '"""Tolerances of ``p_lost``, written by ``experiments/trust/learn.py``: not to be edited by hand."""'
SLOPE = 6.0
"""``p_lost`` falls below 0.05 where the doubt is below one half."""
COMMON = {"clean": 4.0, "crowd": 2.0}
"""Weights of drives: what is common counts more than what is rare."""
_SOLID = replace(REAL.raycast, surface=0.0)
SIMULATED = replace(
    REAL,
    raycast=_SOLID,
    robust_raycast=replace(REAL.robust_raycast, surface=0.0),
    grid=replace(REAL.grid, raycast=replace(REAL.grid.raycast, surface=0.0)),
)
"""What ``localize`` starts from, for worlds whose cells are solid."""


@dataclass(frozen=True)
class Args:
    """Learn when an answer is wrong."""

    out: Path
    """The file of the head."""
    drives: int = 160
    """Simulated drives."""
    runs: int = 3
    """Runs of each."""
    seed: int = 1
    """Seed of the buildings, drives and faults."""
    ridge: float = 0.02
    """Pull towards the prior tolerances."""
    keep: Path | None = None
    """Signs and errors of all drives as .npz, made anew if the file is not there."""


class Seen(NamedTuple):
    """Updates of all drives: signs (n, S), whether the answer was wrong (n,), drive (n,), fault (n,)."""

    signs: np.ndarray
    wrong: np.ndarray
    drive: np.ndarray
    fault: np.ndarray


def main() -> None:
    """Command line."""
    args = parse(Args, "python experiments/trust/learn.py")
    if args.keep and args.keep.exists():
        with np.load(args.keep) as stored:
            seen = Seen(*(stored[name] for name in Seen._fields))
    else:
        seen = collect(args)
        if args.keep:
            np.savez_compressed(args.keep, **seen._asdict())
    head = fit(seen, args.ridge)
    say(seen, np.asarray(p_lost(Signs(*seen.signs.T), head)))
    made = {"drives": int(seen.drive.max()) + 1, "runs": args.runs, "seed": args.seed, "ridge": args.ridge}
    rows = "".join(f'    "{name}": {t:.4g},\n' for name, t in zip(PRIOR, head.tolerances, strict=True))
    words = ", ".join(f'"{name}": {value}' for name, value in made.items())
    args.out.write_text(f"{HEADER}\n\nSLOPE = {head.slope}\nTOLERANCES = {{\n{rows}}}\nMADE = {{{words}}}\n")


def collect(args: Args, settings: Settings = SIMULATED) -> Seen:
    """Localize all drives."""
    rows: list[tuple[Any, ...]] = []
    for number, case in enumerate(cases(args.seed, args.drives)):
        signs, wrong = localize(case, args.seed, number, args.runs, settings)
        rows.append((signs, wrong, np.full(len(wrong), number), np.full(len(wrong), case.fault)))
        print(f"{number:4} {case.fault:14} wrong {wrong.mean():.2f}", flush=True)
    return Seen(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def localize(case: Case, seed: int, number: int, runs: int, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Signs (R * T, S) and whether the answers are wrong (R * T,)."""
    proposal = make_proposal("likelihood_grid", case.grid, case.lidar, settings)
    filter = make_filter("adam_robust", proposal, case.grid, case.lidar, settings)
    filter = watch(filter, case.grid, case.lidar, settings, head=Head(SLOPE, tuple(PRIOR.values())))
    info = run(filter, case.episode, run_keys(seed, number, runs)).info
    e_pos, e_theta = pose_error(info.cluster, case.episode.poses)
    wrong = np.asarray((e_pos > POSITION) | (e_theta > ANGLE))
    return np.stack([np.asarray(s) for s in info.signs], -1).reshape(-1, len(Signs._fields)), wrong.ravel()


def fit(seen: Seen, ridge: float) -> Head:
    """Tolerances that make the labels likely, not far from the prior ones."""
    prior, wrong = np.log(np.array([*PRIOR.values()])), jnp.asarray(seen.wrong, jnp.float32)
    weights = np.array([COMMON.get(str(fault), 1.0) for fault in seen.fault])
    moves = jnp.asarray([name != "crab" for name in PRIOR], jnp.float32)
    signs = Signs(*jnp.asarray(seen.signs.T, jnp.float32))

    @jax.jit
    @jax.value_and_grad
    def loss(shift: Array) -> Array:
        p = jnp.clip(p_lost(signs, Head(SLOPE, tuple(jnp.exp(prior + moves * shift)))), 1e-6, 1 - 1e-6)
        surprise = -jnp.where(wrong > 0, jnp.log(p), jnp.log1p(-p))
        likelihood = jnp.average(surprise, weights=weights / weights.sum())
        return likelihood + ridge * (shift**2).sum()

    found = minimize(lambda x: tuple(np.asarray(v, float) for v in loss(x)), np.zeros(len(prior)), jac=True)
    return Head(SLOPE, tuple(np.exp(prior + np.asarray(moves) * found.x).tolist()))


def say(seen: Seen, p: np.ndarray) -> None:
    """How good probabilities (n,) are, by fault."""
    wrong = seen.wrong.astype(bool)
    print(f"AUROC {auroc(p, wrong):.4f}, ECE {ece(p, wrong):.4f}")
    for fault in np.unique(seen.fault):
        at = seen.fault == fault
        sure = p[at] < CERTAIN
        both = (sure & wrong[at]).mean()
        print(f"  {fault:14} wrong {wrong[at].mean():.3f}  certain {sure.mean():.3f}  both {both:.4f}")


if __name__ == "__main__":
    run_cli(main)
