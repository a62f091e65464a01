"""A map and a log of a drive through it, in the current folder: ``map.yaml``, ``drive.log``, ``truth.tum``."""

import math
from pathlib import Path

import numpy as np

import dsom_jax as dj
from dsom_jax.data.suite import load_suite
from dsom_jax.raycast import RaycastConfig, cast_rays, make_tables

_, grid, episode = load_suite("synthetic-v1").episodes[0]
dj.save_ros_map(grid, Path("map.yaml"))
# What a reader takes a CARMEN scan of 180 readings for.
lidar = dj.LidarConfig(beams=180, angle_min=-math.pi / 2, angle_increment=math.pi / 180, range_max=8.0)
poses = np.asarray(episode.poses[:60])
scans = np.minimum(np.asarray(cast_rays(make_tables(grid, RaycastConfig("exact"), 8.0), poses, lidar)), 8.19)
log, truth = [], []
for t, ((x, y, theta), scan) in enumerate(zip(poses, scans, strict=True)):
    place = f"{x:.4f} {y:.4f} {theta:.5f}"
    log.append(f"FLASER 180 {' '.join(f'{r:.2f}' for r in scan)} {place} {place} {t} robot {t}\n")
    truth.append(f"{t} {x:.4f} {y:.4f} 0 0 0 {math.sin(theta / 2):.6f} {math.cos(theta / 2):.6f}\n")
Path("drive.log").write_text("".join(log))
Path("truth.tum").write_text("".join(truth))
