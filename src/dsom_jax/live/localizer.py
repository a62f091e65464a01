"""One robot, live: a scan and an odometry pose go in, where the robot is and whether to trust it come out.

The update is :func:`dsom_jax.montecarlo.update`, the one that Monte-Carlo runs scan over, with one run: on the same
updates both give the same numbers, bit for bit. Everything is compiled when a :class:`Localizer` is made, and what was
compiled is kept for the next process in the user's cache folder.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dsom_jax import montecarlo
from dsom_jax.atomic import write_atomic
from dsom_jax.cache import keep_compiled
from dsom_jax.compiling import run_options
from dsom_jax.data import se2
from dsom_jax.data.cut import far_enough
from dsom_jax.data.log import limit_ranges
from dsom_jax.errors import UserError
from dsom_jax.filters.methods import make_filter, make_proposal, watch
from dsom_jax.filters.settings import REAL, Settings
from dsom_jax.lidar import LidarConfig
from dsom_jax.live.answer import NOWHERE, Answer, Hypothesis, moved, read_saved, said
from dsom_jax.live.update import around, inner, keys_of, one_update, particles_of
from dsom_jax.montecarlo import run_keys
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.types import Filter, Inputs, Key

_BACK = 5.0
"""Seconds: stamps that run back by less are late scans, by more a clock that was set back."""
_JUMP = (1.0, 5.0)
"""Metres, and metres per second, that no odometry moves between two scans unless it was reset."""
_SPIN = (1.0, 6.0)
"""Radians, and radians per second, likewise."""
_PATIENCE = 10.0
"""Seconds that count at most for both."""
_ONCE = np.int32(1)
_RESTORED = np.diag([0.25, 0.25, 0.1]) ** 2
"""Covariance (m, m, rad) added to a pose that was saved: somebody may have pushed the robot."""


class Localizer:
    """Finds and follows one robot on a known map. Not safe for threads: one thread owns it.

    Args:
        grid: the map.
        lidar: geometry of the scans, fixed.
        settings: of AdaM robust.
        seed: of all randomness; run 0 of ``montecarlo.run`` with ``run_keys(seed, 0, runs)`` has the same.
        update_min_d, update_min_a: metres driven or radians turned between updates; may be changed at any time.
        filter: another filter than AdaM robust with the likelihood grid; then ``settings`` is not read.
    """

    def __init__(
        self,
        grid: OccupancyGrid,
        lidar: LidarConfig,
        settings: Settings = REAL,
        seed: int = 0,
        *,
        update_min_d: float = 0.25,
        update_min_a: float = 0.2,
        filter: Filter | None = None,
    ) -> None:
        keep_compiled()
        if filter is None:
            proposal = make_proposal("likelihood_grid", grid, lidar, settings)
            filter = watch(make_filter("adam_robust", proposal, grid, lidar, settings), grid, lidar, settings)
        self.grid, self.lidar = grid, lidar
        self.update_min_d, self.update_min_a = update_min_d, update_min_a
        self._filter, self._root, self._starts = filter, run_keys(seed, 0, 1), 0
        self._odometry: np.ndarray | None = None
        self._anchor, self._stamp = np.zeros(3), -math.inf
        self._index, self._memory, self._states = 0, None, None
        self._compile()
        self.relocalize(self._root)

    def _compile(self) -> None:
        """All that will ever be called, for the shapes that it will be called with."""
        options = run_options()
        blank = Inputs(np.full(self.lidar.beams, np.nan, np.float32), np.zeros(3, np.float32), np.int32(0))  # type: ignore[arg-type]
        start = jax.jit(montecarlo.start, compiler_options=options).lower(self._filter, self._root)
        memory, states = start.out_info
        step = jax.jit(one_update, donate_argnums=(2, 3), compiler_options=options)
        self._start = start.compile()
        self._step = step.lower(self._filter, self._root, memory, states, blank, _ONCE).compile()
        self._keys_of = jax.jit(keys_of).lower(self._root, np.uint32(0)).compile()
        self._particles = jax.jit(particles_of).lower(states).compile()
        self._around = None
        if hasattr(inner(self._filter, "filter"), "around"):
            place = jax.jit(around, compiler_options=options)
            told = np.zeros(3, np.float32), np.zeros((3, 3), np.float32)
            self._around = place.lower(self._filter, self._root, *told).compile()

    def update(self, ranges: Any, odometry_pose: Any, stamp: float) -> Answer:
        """The answer for a scan (B,) in metres, taken at ``odometry_pose`` (3,) of the base in the odometry frame.

        The scan is used if the robot has moved enough since the last one that was. Out of the ordinary:

        - a stamp not newer than the last, or numbers that are not finite: the last answer, nothing changes;
        - a stamp more than five seconds back: the clock was set back, and time goes on from there;
        - an odometry that jumps farther than a robot moves: it was reset; the jump is taken for none, the scan is used;
        - another number of beams: taken to span the same angle, each beam of the geometry is the nearest of them.
        """
        begun = time.perf_counter()
        odometry = np.asarray(odometry_pose, np.float64)
        refused = self._refused(odometry, stamp)
        if refused:
            return self._carried(stamp, refused)._replace(seconds=time.perf_counter() - begun)
        note = self._follow(odometry, stamp)
        if self._due:
            fitted = limit_ranges(self._fitted(ranges), self.lidar.range_min, self.lidar.range_max)
            answer = self.advance(fitted, se2.relative(self._anchor, odometry), stamp)
            self._anchor = odometry
        else:
            answer = self._carried(stamp)
        return answer._replace(note=note, seconds=time.perf_counter() - begun)

    def _refused(self, odometry: np.ndarray, stamp: float) -> str:
        """Why nothing can be done with a scan; empty if something can."""
        if odometry.shape != (3,):
            raise ValueError(f"odometry_pose has shape {odometry.shape}: give (x, y, theta)")
        if not (np.isfinite(odometry).all() and math.isfinite(stamp)):
            return "odometry or stamp is not finite"
        late = self._stamp - stamp
        if 0 <= late < _BACK:
            return "stamp is that of the scan before" if late == 0 else "stamp is older than the last"
        return ""

    def _follow(self, odometry: np.ndarray, stamp: float) -> str:
        """Move the odometry on to a sound pose and say whether it jumped."""
        note = ""
        if self._odometry is None:
            self._anchor = odometry
        else:
            elapsed = min(max(stamp - self._stamp, 0.0), _PATIENCE)
            x, y, turn = np.abs(se2.relative(self._odometry, odometry))
            if math.hypot(x, y) > _JUMP[0] + _JUMP[1] * elapsed or turn > _SPIN[0] + _SPIN[1] * elapsed:
                note = "odometry jumped; taken for a reset"
                # What was driven before the jump still counts.
                driven = se2.relative(self._anchor, self._odometry)
                self._anchor = se2.compose(odometry, se2.inverse(driven))
                self._forced = True
        self._odometry, self._stamp = odometry, stamp
        return note

    @property
    def _due(self) -> bool:
        """Whether the robot has moved enough for an update."""
        assert self._odometry is not None
        return self._forced or far_enough(self._anchor, self._odometry, self.update_min_d, self.update_min_a)

    def _fitted(self, ranges: Any) -> np.ndarray:
        """(B,) of a scan with any number of beams over the same angle."""
        ranges = np.asarray(ranges, np.float32).reshape(-1)
        if len(ranges) == self.lidar.beams:
            return ranges
        if not len(ranges):
            return np.full(self.lidar.beams, np.nan, np.float32)
        return ranges[np.rint(np.linspace(0, len(ranges) - 1, self.lidar.beams)).astype(int)]

    def advance(self, ranges: np.ndarray, motion: np.ndarray, stamp: float) -> Answer:
        """One update with REP-117 ranges (B,) and the body-frame ``motion`` (3,) since the last, whatever it is."""
        begun = time.perf_counter()
        inputs = Inputs(np.asarray(ranges, np.float32), np.asarray(motion, np.float32), np.int32(self._index))  # type: ignore[arg-type]
        self._memory, self._states, told = self._step(
            self._filter, self._keys, self._memory, self._states, inputs, _ONCE
        )
        info, covariance = jax.tree.map(np.asarray, told)  # on a CPU a tenth of what device_get takes
        self._index, self._forced, self.info = self._index + 1, False, info
        pose, covariance = np.asarray(info.cluster, np.float64), np.asarray(covariance, np.float64)
        p_lost, verdict, places = said(info, pose, covariance)
        self._last = Answer(stamp, pose, covariance, verdict, p_lost, places, updated=True)
        return self._last._replace(seconds=time.perf_counter() - begun)

    @property
    def _driven(self) -> np.ndarray:
        """Motion (3,) since the last answer."""
        return np.zeros(3) if self._odometry is None else se2.relative(self._anchor, self._odometry)

    def _carried(self, stamp: float, note: str = "") -> Answer:
        """The last answer moved on by the odometry."""
        last, driven = self._last, self._driven
        pose, covariance = moved(last.pose, last.covariance, driven)
        places = tuple(Hypothesis(h.weight, *moved(h.pose, h.covariance, driven)) for h in last.hypotheses)
        return last._replace(stamp=stamp, pose=pose, covariance=covariance, hypotheses=places, updated=False, note=note)

    def answer(self) -> Answer:
        """The last answer again, moved on by the odometry."""
        return self._carried(self._stamp)

    def set_pose(self, pose: Sequence[float] | np.ndarray, covariance: Any, odometry_pose: Any = None) -> None:
        """Start again from a pose (3,) in the map frame with a covariance (3, 3), and that of the odometry there.

        Without ``odometry_pose`` it is the last one that came with a scan. The pose is taken at its word until the next
        scan, which is used even if the robot stands still.

        Raises:
            UserError: nothing of it lies on free space, or it is not finite.
            TypeError: the filter cannot start from a pose.
        """
        if self._around is None:
            kind = type(inner(self._filter, "filter")).__name__
            raise TypeError(f"{kind} cannot start from a pose; use AdaM robust")
        told = np.asarray(pose, np.float64), np.asarray(covariance, np.float64)
        if told[0].shape != (3,) or told[1].shape != (3, 3) or not all(np.isfinite(v).all() for v in told):
            raise UserError(f"set_pose: pose = {pose}, covariance = {covariance}: give finite (3,) and (3, 3)")
        if np.linalg.eigvalsh(told[1]).min() < -1e-9:
            raise UserError(f"set_pose: covariance = {told[1].tolist()}: has a negative variance")
        keys = self._next_keys()
        memory, states, free = self._around(self._filter, keys, *(v.astype(np.float32) for v in told))
        if not float(free) > 0:
            x, y, _ = told[0]
            raise UserError(f"set_pose: ({x:.2f}, {y:.2f}) is nowhere near free space of the map")
        if odometry_pose is not None and np.isfinite(odometry_pose).all():
            self._odometry = np.asarray(odometry_pose, np.float64)
        self._begin(keys, memory, states, index=1)
        place = Hypothesis(1.0, told[0], told[1])
        self._last = Answer(self._stamp, *told, "localized", 0.0, (place,))

    def relocalize(self, keys: Key | None = None) -> None:
        """Forget where the robot is and look for it everywhere; ``keys`` (1,) are those of a Monte-Carlo run."""
        keys = self._next_keys() if keys is None else keys
        memory, states = self._start(self._filter, keys)
        self._begin(keys, memory, states, index=0)
        self._last = NOWHERE

    def _next_keys(self) -> Key:
        """(1,) keys that no start has had."""
        self._starts += 1
        return self._keys_of(self._root, np.uint32(2**31 + self._starts))

    def _begin(self, keys: Key, memory: Any, states: Any, index: int) -> None:
        self._keys, self._memory, self._states, self._index = keys, memory, states, index
        self._forced = True
        if self._odometry is not None:
            self._anchor = self._odometry

    def force(self) -> None:
        """Use the next scan even if the robot stands still."""
        self._forced = True

    def state(self) -> Any:
        """The filter's own state after the last update, a copy."""
        return jax.tree.map(lambda leaf: np.array(leaf[0]), jax.device_get(inner(self._states, "state")))

    def particles(self) -> tuple[np.ndarray, np.ndarray]:
        """Poses (N, 3) in the map frame, moved on by the odometry, and weights (N,) that sum to one."""
        poses, weights = jax.device_get(self._particles(self._states))
        return se2.compose(np.asarray(poses[0], np.float64), self._driven), np.asarray(weights[0], np.float64)

    def save(self, path: str | Path) -> None:
        """Write the pose to a JSON file, atomically, for :meth:`restore` after a restart."""
        answer = self.answer()
        write_atomic(path, json.dumps({
            "pose": answer.pose.tolist(), "covariance": answer.covariance.tolist(), "verdict": answer.verdict,
            "stamp": answer.stamp, "map": self._map(),
        }).encode())  # fmt: skip

    def restore(self, path: str | Path) -> bool:
        """Start from a pose that was saved; False, and nothing changes, if it was not to be trusted even then.

        Raises:
            UserError: no such file, not one of ours, of another map, or off the free space of this one.
        """
        pose, covariance, trusted = read_saved(path, self._map())
        if trusted:
            self.set_pose(pose, covariance + _RESTORED)
        return trusted

    def _map(self) -> list[Any]:
        """What tells maps apart."""
        return [*self.grid.shape, self.grid.resolution, *np.asarray(self.grid.origin, np.float64).round(4).tolist()]
