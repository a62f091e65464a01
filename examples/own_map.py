"""A map of one's own, drawn by hand, and a robot that is found on it: ``python examples/own_map.py``.

Two arrays of booleans make a map: what stops a ray, and where the robot may stand. A real one comes from
``dj.load_map("map.yaml")``, a real drive from ``dj.load_log("drive.bag")`` and ``dj.segments(log)``.
"""

from __future__ import annotations

import numpy as np

import dsom_jax as dj

PLAN = """
    ########################
    #........#.............#
    #........#.............#
    #......................#
    #........#.......####..#
    #####.####..........#..#
    #...................#..#
    #......................#
    #...##.................#
    #...##......##.........#
    #......................#
    ########################
"""
LIDAR = dj.LidarConfig(beams=60, angle_increment=2 * np.pi / 60, range_max=8.0)


def room() -> dj.OccupancyGrid:
    """The plan at 0.25 m per cell; row 0 of a map is at the bottom."""
    walls = np.array([[c == "#" for c in row] for row in PLAN.split()[::-1]])
    return dj.from_cells(np.kron(walls, np.ones((2, 2), bool)), resolution=0.25)


def drive() -> dj.Episode:
    """Twelve updates, then the robot is carried at least 4 m away, and twelve more; two things are not on the map."""
    config = dj.DriveConfig(updates=(12, 12), kidnap_distance=4.0, obstacles=2, removed=0, lidar=LIDAR)
    return dj.make_synthetic(3, room(), config)[1]


def last_error(filter: dj.Filter, runs: int = 4) -> float:
    """Median error of the heaviest cluster at the end of the drive, metres."""
    episode = drive()
    result = dj.run(filter, episode, dj.run_keys(seed=0, episode=0, runs=runs))
    return float(np.median(dj.pose_error(result.info.cluster, episode.poses)[0][:, -1]))


if __name__ == "__main__":
    settings = dj.Settings(particles=100)
    proposal = dj.make_proposal("likelihood_grid", room(), LIDAR, settings)
    error = last_error(dj.make_filter("adam_robust", proposal, room(), LIDAR, settings))
    print(f"error at the end: {error:.2f} m")
    assert error < 0.5
