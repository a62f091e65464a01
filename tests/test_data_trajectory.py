"""TUM trajectories, with evo as the oracle for reading and association."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from evo.core import sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dsom_jax.data import se2
from dsom_jax.data.log import RawLog
from dsom_jax.data.trajectory import Trajectory, associate, load_tum, save_tum, with_reference, yaw_of
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig


def random_walk(seed: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    stamps = 1.6e9 + np.cumsum(rng.uniform(0.05, 0.5, n))
    return stamps, np.column_stack([rng.normal(0, 30, (n, 2)), rng.uniform(-np.pi, np.pi, n)])


def test_round_trip_and_evo_reads_the_same(tmp_path: Path) -> None:
    stamps, poses = random_walk(0, 50)
    path = tmp_path / "sub" / "a.tum"
    save_tum(path, stamps, poses)
    mine, evo = load_tum(path), file_interface.read_tum_trajectory_file(str(path))
    # Positions are written to a micrometre, quaternions to 1e-9.
    np.testing.assert_allclose(mine.poses[:, :2], poses[:, :2], atol=1e-6)
    np.testing.assert_allclose(se2.wrap(mine.poses[:, 2] - poses[:, 2]), 0, atol=1e-8)
    np.testing.assert_allclose(mine.stamps, stamps, atol=1e-6)
    np.testing.assert_array_equal(mine.stamps, evo.timestamps)
    np.testing.assert_allclose(mine.poses[:, :2], evo.positions_xyz[:, :2])
    yaw = evo.get_orientations_euler()[:, 2]
    np.testing.assert_allclose(se2.wrap(mine.poses[:, 2] - yaw), 0, atol=1e-8)


@given(yaw=st.floats(-3.1, 3.1), pitch=st.floats(-1.5, 1.5), roll=st.floats(-3.1, 3.1), scale=st.floats(0.1, 10))
@settings(max_examples=60, deadline=None)
def test_yaw_of_tilted_quaternions(yaw: float, pitch: float, roll: float, scale: float) -> None:
    quaternion = scale * Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
    # Close to the pole yaw is lost in rounding: 1e-16 / cos(1.5)^2.
    assert abs(se2.wrap(yaw_of(quaternion) - yaw)) < 1e-9


def test_association_agrees_with_evo() -> None:
    stamps, poses = random_walk(1, 200)
    rng = np.random.default_rng(2)
    # Within the tolerance of a reference stamp, and in the middle of nowhere.
    asked = np.sort(np.concatenate([stamps[::3] + rng.uniform(-0.009, 0.009, 67), stamps[1:-1:5] + 0.025]))
    mine = associate(Trajectory(stamps, poses), asked, tolerance=0.01, max_gap=0.0)

    def evo_trajectory(times: np.ndarray, values: np.ndarray) -> PoseTrajectory3D:
        quaternions = np.zeros((len(times), 4))
        quaternions[:, 0] = 1
        return PoseTrajectory3D(np.column_stack([values[:, :2], 0 * times]), quaternions, times)

    reference, matched = sync.associate_trajectories(
        evo_trajectory(stamps, poses), evo_trajectory(asked, np.zeros((len(asked), 2))), max_diff=0.01
    )
    known = np.isfinite(mine).all(-1)
    np.testing.assert_array_equal(asked[known], matched.timestamps)
    np.testing.assert_array_equal(mine[known, :2], reference.positions_xyz[:, :2])


def test_interpolation_in_small_gaps_only_and_over_the_wrap() -> None:
    track = Trajectory(np.array([0.0, 1.0, 5.0]), np.array([[0, 0, 3.1], [2, 4, -3.1], [9, 9, 0]]))
    poses = associate(track, np.array([-0.5, 0.25, 1.005, 3.0, 5.5]), tolerance=0.01, max_gap=2.0)
    np.testing.assert_array_equal(np.isfinite(poses).all(-1), [False, True, True, False, False])
    # A quarter of the short way over pi.
    turn = 2 * np.pi - 6.2
    np.testing.assert_allclose(poses[1], [0.5, 1.0, se2.wrap(3.1 + turn / 4)])
    np.testing.assert_array_equal(poses[2], track.poses[1])


def test_one_pose_is_enough() -> None:
    poses = associate(Trajectory(np.array([1.0]), np.array([[1.0, 2.0, 3.0]])), np.array([1.0, 2.0]))
    np.testing.assert_array_equal(poses, [[1, 2, 3], [np.nan] * 3])


def test_rows_are_sorted_and_comments_skipped(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text("# stamp x y z\n2 1 0 0 0 0 0 1\n\n1 5 6 0 0 0 0.6 0.8  # early\n")
    track = load_tum(path)
    np.testing.assert_array_equal(track.stamps, [1, 2])
    np.testing.assert_allclose(track.poses[0], [5, 6, 2 * np.arctan2(0.6, 0.8)])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n", "line 1: must be"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 x 1\n", "line 2: must be"),
        ("1 0 0 0 0 0 0 0\n", "quaternion that is not zero"),
        ("1 nan 0 0 0 0 0 1\n", "line 1: must be"),
        ("# nothing\n", "holds no pose"),
    ],
)
def test_bad_trajectories(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "a.tum"
    path.write_text(text)
    with pytest.raises(UserError, match=f"a.tum: .*{message}"):
        load_tum(path)


def test_missing_and_unwritable(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such trajectory"):
        load_tum(tmp_path / "no.tum")
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        save_tum(tmp_path / "file" / "a.tum", np.zeros(1), np.zeros((1, 3)))
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError, match="cannot be written"):
        save_tum(tmp_path / "folder", np.zeros(1), np.zeros((1, 3)))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]


def test_a_reference_in_another_clock_is_an_error(tmp_path: Path) -> None:
    stamps, poses = random_walk(3, 10)
    save_tum(tmp_path / "a.tum", stamps, poses)
    log = RawLog(np.ones((10, 4), np.float32), poses, stamps, LidarConfig(beams=4))
    np.testing.assert_allclose(with_reference(log, tmp_path / "a.tum").reference[:, :2], poses[:, :2], atol=1e-6)
    later = RawLog(np.ones((10, 4), np.float32), poses, stamps + 1e6, LidarConfig(beams=4))
    with pytest.raises(UserError, match="same clock"):
        with_reference(later, tmp_path / "a.tum")
