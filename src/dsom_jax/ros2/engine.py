"""What the node does, without ROS: the newest scan goes through the filter, all others are dropped.

Callbacks of any thread only leave things here; one worker thread calls :meth:`Engine.step` and owns the filter.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dsom_jax.data import se2
from dsom_jax.errors import UserError
from dsom_jax.live import Localizer
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.ros2.exchange import Counts, Output, Told, Trusted, same
from dsom_jax.ros2.messages import Scan, fitted, lidar_of_scan
from dsom_jax.ros2.parameters import Parameters, settings_of
from dsom_jax.ros2.transforms import Transforms

_WAITING = 20
"""Scans that wait for their odometry, at most; of those that have it only the newest is used."""
_TILT = np.radians(5.0)
_NAV2_COVARIANCE = np.diag([0.25, 0.25, 0.06853891909])
"""Of an initial pose from parameters, as in nav2_amcl (m2, m2, rad2)."""


class Engine:
    """Filter, transforms and what waits for them.

    Args:
        parameters: at the start; those that may change are read from ``self.parameters``.
        say: called with (level, text) for the log.
        make: what makes the filter, for tests.
    """

    def __init__(
        self,
        parameters: Parameters,
        say: Callable[[str, str], None] = lambda level, text: None,
        make: Callable[..., Any] = Localizer,
    ) -> None:
        self.parameters, self._say, self._make = parameters, say, make
        self.counts, self.transforms = Counts(), Transforms()
        self.localizer: Any = None
        self._wake = threading.Condition()
        self._active, self._stopped = False, False
        self._scans: deque[tuple[Scan, float]] = deque(maxlen=_WAITING)
        self._map: OccupancyGrid | None = None
        self._grid: OccupancyGrid | None = None
        self._told: Told | None = None
        self._resume: Trusted | None = None
        self._lost, self._forced = False, False
        self._frame = ""
        self._trusted: np.ndarray | None = None
        self._saved, self._complained = 0.0, ""

    # What callbacks do

    def hear_transforms(self, message: Any, static: bool) -> None:
        """Enter a TFMessage."""
        with self._wake:
            self.transforms.add(message, static)
            self._wake.notify()

    def hear_scan(self, scan: Scan) -> None:
        """Enter a scan; those that wait too long are dropped."""
        with self._wake:
            self.counts.received += 1
            if self._active:
                self.counts.dropped += len(self._scans) == _WAITING
                self._scans.append((scan, time.monotonic()))
                self._wake.notify()

    def hear_map(self, grid: OccupancyGrid) -> None:
        """Enter a map; it replaces the one before, unless only the first counts."""
        with self._wake:
            if self.parameters.first_map_only and (self._grid or self._map) is not None:
                self._say("info", "another map came; it is left out, as first_map_only is set")
                return
            self._map = grid
            self._wake.notify()

    def hear_pose(self, pose: np.ndarray, covariance: np.ndarray, stamp: float) -> None:
        """Start from a pose; it is kept if nothing runs yet."""
        with self._wake:
            # Looked up at once: while a filter is made, transforms grow too old to be kept.
            self._told = Told(pose, covariance, stamp, self._odometry_at(stamp) if stamp else None)
            self._wake.notify()

    def look_everywhere(self) -> None:
        """Forget where the robot is."""
        with self._wake:
            self._lost, self._told = True, None

    def use_next(self) -> None:
        """Use the next scan even if the robot stands."""
        with self._wake:
            self._forced = True

    def activate(self) -> None:
        """Take scans from now on."""
        with self._wake:
            self._active = True
            if self.parameters.always_reset_initial_pose and self.localizer is not None:
                self._lost, self._told = True, self._told or self._preset()

    def deactivate(self) -> None:
        """Take no scans; the filter keeps where it is."""
        with self._wake:
            self._active = False
            self._scans.clear()

    def stop(self) -> None:
        """End :meth:`run`."""
        with self._wake:
            self._stopped = True
            self._wake.notify()

    # What the worker does

    def run(self, publish: Callable[[Output], None]) -> None:
        """Answer scans until :meth:`stop`."""
        while not self._stopped:
            output = self.step()
            if output is not None:
                publish(output)
            else:
                with self._wake:
                    self._wake.wait(0.1)

    def step(self) -> Output | None:
        """Take what has come since, and answer the newest scan whose odometry is known; None if there is none."""
        with self._wake:
            taken = self._newest() if self._active else None
            grid, self._map = self._map, None
        if grid is not None and not (self._grid is not None and same(grid, self._grid)):
            self._change_map(grid)
        if taken is None or self._grid is None:
            return None
        (scan, came), odometry = taken
        if self.localizer is None:
            self._build(scan)
            return None
        if scan.frame != self._frame:
            self._complain(f"scans of frame {scan.frame} are left out, those of {self._frame} are used")
            return None
        with self._wake:
            told, lost, forced = self._told, self._lost, self._forced
            self._told, self._lost, self._forced = None, False, False
        self._obey(told, lost, forced, odometry)
        return self._answer(scan, came, odometry)

    def _newest(self) -> tuple[tuple[Scan, float], np.ndarray] | None:
        """The newest scan whose odometry is known, with it; older ones are dropped, newer ones wait."""
        for back, (scan, came) in enumerate(reversed(self._scans)):
            odometry = self._odometry_at(scan.stamp)
            if odometry is not None:
                older = len(self._scans) - back - 1
                for _ in range(older + 1):
                    self._scans.popleft()
                self.counts.dropped += older
                return (scan, came), odometry
        if len(self._scans) == _WAITING:
            frames = self.parameters.odom_frame_id, self.parameters.base_frame_id
            self._complain(f"no transform {frames[0]} -> {frames[1]} at the stamps of the scans")
        return None

    def _odometry_at(self, stamp: float) -> np.ndarray | None:
        """Pose (3,) of the odometry at a stamp; None while it cannot be told. Its caller locks."""
        return self.transforms.planar(self.parameters.odom_frame_id, self.parameters.base_frame_id, stamp)

    def _change_map(self, grid: OccupancyGrid) -> None:
        """Another map: the filter is made anew, and goes on where it was if it knew."""
        self._grid = grid
        if self.localizer is not None:
            last = self.localizer.answer()
            if last.localized and self._trusted is not None:
                self._resume = Trusted(self._trusted, last.covariance + _NAV2_COVARIANCE)
            self.localizer = None
            self._say("info", "another map: the filter is made anew")

    def _build(self, scan: Scan) -> None:
        """Make the filter for the geometry of a scan, which takes a while, and tell it what is known."""
        assert self._grid is not None
        base = self.parameters.base_frame_id
        with self._wake:
            mount = self.transforms.mount(base, scan.frame, scan.stamp)
        if mount is None:
            self._complain(f"no transform {base} -> {scan.frame} yet: scans cannot be used")
            return
        if mount.tilt > _TILT:
            self._say("warn", f"the laser is tilted by {np.degrees(mount.tilt):.0f} deg: no horizontal cut")
        try:
            lidar = lidar_of_scan(scan, mount, self.parameters.laser_min_range, self.parameters.reach)
        except UserError as error:
            self._complain(str(error))
            return
        begun, seed = time.monotonic(), self.parameters.random_seed
        self._say("info", f"making the filter for {lidar.beams} beams and a map of {self._grid.shape} cells")
        self.localizer = self._make(
            self._grid,
            lidar,
            settings_of(self.parameters),
            seed if seed >= 0 else int(time.time()) % 2**32,
            update_min_d=self.parameters.update_min_d,
            update_min_a=self.parameters.update_min_a,
        )
        self._frame, self._trusted = scan.frame, None
        self._say("info", f"the filter is ready after {time.monotonic() - begun:.1f} s")
        self._start()

    def _start(self) -> None:
        """From the pose that was told, of the map before, saved, or preset; else the filter looks everywhere."""
        with self._wake:
            waiting = self._told is not None or self._resume is not None
        if not waiting and self.parameters.initialize_at_saved_pose and self.parameters.saved_pose_filepath:
            try:
                if self.localizer.restore(self.parameters.saved_pose_filepath):
                    self._say("info", f"starts from {self.parameters.saved_pose_filepath}")
                    return
            except UserError as error:
                self._say("warn", str(error))
        if not waiting:
            with self._wake:
                # A pose that has come meanwhile is worth more.
                self._told = self._told or self._preset()

    def _preset(self) -> Told | None:
        """The initial pose of the parameters."""
        p = self.parameters
        if not p.set_initial_pose:
            return None
        return Told(np.array([p.initial_pose_x, p.initial_pose_y, p.initial_pose_yaw]), _NAV2_COVARIANCE, 0.0)

    def _obey(self, told: Told | None, lost: bool, forced: bool, odometry: np.ndarray) -> None:
        """Do what was asked for since the last scan, and go on from the map before if nothing was."""
        resume, self._resume = self._resume, None
        self.localizer.update_min_d = self.parameters.update_min_d
        self.localizer.update_min_a = self.parameters.update_min_a
        if lost:
            self.localizer.relocalize()
            self._trusted = None
        elif told is None and resume is not None:
            told = Told(se2.compose(resume.map_to_odom, odometry), resume.covariance, 0.0)
        if told is not None:
            self._place(told, odometry)
        if forced:
            self.localizer.force()

    def _place(self, told: Told, odometry: np.ndarray) -> None:
        """Start from a pose that was told; ``odometry`` is that of now."""
        then = told.odometry
        if then is None and told.stamp:
            with self._wake:
                then = self._odometry_at(told.stamp)
        try:
            self.localizer.set_pose(told.pose, told.covariance, odometry if then is None else then)
        except UserError as error:
            self._say("warn", str(error))

    def _answer(self, scan: Scan, came: float, odometry: np.ndarray) -> Output:
        """The filter's answer to a scan."""
        ranges = fitted(scan, self.localizer.lidar)
        answer = self.localizer.update(ranges, odometry, scan.stamp)
        if answer.note:
            self._complain(answer.note)
        if answer.localized:
            self._trusted = se2.compose(answer.pose, se2.inverse(odometry))
            self._save()
        trusted = self._trusted if answer.localized or self.parameters.publish_while_lost else None
        latency = time.monotonic() - came
        self.counts.answered += 1
        self.counts.updated += answer.updated
        self.counts.latencies.append(latency)
        return Output(answer, trusted, int(np.isfinite(ranges).sum()), latency)

    def _save(self) -> None:
        """Write the pose, as often as asked for."""
        path, rate, now = self.parameters.saved_pose_filepath, self.parameters.save_pose_rate, time.monotonic()
        if path and rate > 0 and now - self._saved >= 1 / rate:
            self._saved = now
            try:
                self.localizer.save(Path(path))
            except UserError as error:
                self._complain(str(error))

    def _complain(self, text: str) -> None:
        """Warn, but not with every scan."""
        if text != self._complained:
            self._complained = text
            self._say("warn", text)
