"""Where a building is ambiguous: a symmetric one names its look-alikes, the same with one thing in it has none."""

from __future__ import annotations

import json
import math
import sys

import numpy as np
import pytest

from dsom_jax import certify
from dsom_jax.ambiguity import AmbiguityConfig, Tried, log_odds, look_alikes, try_out
from dsom_jax.data.ros_map import save_ros_map
from dsom_jax.errors import run_cli
from dsom_jax.lidar import LidarConfig, LidarNoise
from dsom_jax.occupancy import from_cells

LIDAR = LidarConfig(beams=60, angle_min=-math.pi, angle_increment=2 * math.pi / 60, range_max=8.0)
CONFIG = AmbiguityConfig(
    drives=6, updates=14, headings=24, batch=6, noise=LidarNoise(sigma=0.02), temper=0.2, step=(0.4, 0.4)
)
SIZE = (10.0, 6.0)


def building(symmetric=True):
    """10 m x 6 m, the same after half a turn; or with a cupboard that makes the difference."""
    cells = np.zeros((24, 40), bool)
    cells[[0, -1]] = cells[:, [0, -1]] = True
    cells[1:8, 12] = cells[16:23, 27] = True
    cells[10:14, 18:22] = True
    if not symmetric:
        cells[2:7, 34:39] = True
    assert symmetric == (cells == cells[::-1, ::-1]).all()
    return from_cells(cells, resolution=0.25, origin=(1.0, -2.0, 0.0))


@pytest.fixture(scope="module")
def symmetric():
    return try_out(building(), LIDAR, CONFIG, seed=1)


@pytest.fixture(scope="module")
def plain():
    return try_out(building(False), LIDAR, CONFIG, seed=1)


def half_turn(pose):
    """The pose that sees the same."""
    x, y, theta = pose
    return np.array([2 * 1.0 + SIZE[0] - x, -2 * 2.0 + SIZE[1] - y, theta + np.pi])


def test_half_of_the_belief_stays_at_the_other_end(symmetric):
    last = symmetric.truth[:, -1], symmetric.other[:, -1]
    np.testing.assert_allclose(last[0] + last[1], 1.0, atol=0.1)
    # Noise tips the scales a little, knowledge would end at 0 or 1.
    assert (np.abs(last[0] - 0.5) < 0.35).all()
    assert np.isinf(symmetric.metres_until_found()).all()


def test_look_alikes_are_half_a_turn_away(symmetric):
    pairs = look_alikes(symmetric, 2.0)
    assert pairs
    for d, t in pairs:
        gap = half_turn(symmetric.poses[d, t]) - symmetric.other_pose[d, t]
        assert np.hypot(*gap[:2]) < 1.0 and abs((gap[2] + np.pi) % (2 * np.pi) - np.pi) < math.radians(16)
        assert abs(log_odds(symmetric, d, t)) < 2.0


def test_one_cupboard_makes_the_difference(plain):
    # Whoever starts where the cupboard is not seen has to drive until it is, and that it is not is seen, too.
    assert (plain.metres_until_found() < 5).mean() >= 0.8
    assert (plain.truth[:, -1] > 0.9).mean() >= 0.8


def test_pairs_are_told_once():
    poses = np.zeros((3, 2, 3))
    poses[:, :, 0] = np.array([0.0, 0.5, 20.0])[:, None]
    other = np.full((3, 2, 3), 10.0)
    other[2] = 0.2
    held = np.array([[0.5] * 2, [0.4] * 2, [0.01] * 2])
    tried = Tried(poses, np.tile([0.0, 3.0], (3, 1)), np.full((3, 2), 0.5), held, other)
    assert look_alikes(tried, 2.0) == [(0, 1)]  # the second is the first again, the third holds next to nothing
    turned = tried._replace(poses=other, other_pose=poses)
    assert look_alikes(turned, 2.0, least=0.001)[0] == (0, 1)


def test_metres_until_found():
    truth = np.array([[0.1, 0.96, 0.3], [0.1, 0.2, 0.3], [0.99, 0.99, 0.99]])
    metres = np.tile([0.0, 1.5, 3.0], (3, 1))
    tried = Tried(np.zeros((3, 3, 3)), metres, truth, 1 - truth, np.zeros((3, 3, 3)))
    assert tried.metres_until_found().tolist() == [1.5, math.inf, 0.0]
    result, _ = certify.certify(tried, building())
    assert result["found_after_m"] == {"0": 1 / 3, "2": 2 / 3, "5": 2 / 3, "10": 2 / 3}
    free = np.asarray(building().free).sum() / 16
    assert result["area_m2"] == pytest.approx(free)


@pytest.fixture
def call(tmp_path, monkeypatch, capsys, symmetric):
    """The command on the symmetric building, its computation being that of the fixture."""
    save_ros_map(building(), tmp_path / "twins.yaml")
    monkeypatch.setattr(certify, "try_out", lambda *_: symmetric)

    def go(*words):
        monkeypatch.setattr(sys, "argv", ["certify", "--map", str(tmp_path / "twins.yaml"), *words])
        run_cli(certify.main)
        return capsys.readouterr().out

    return go


def test_command(call, tmp_path):
    printed = call("--out", str(tmp_path / "out"))
    result = json.loads((tmp_path / "out" / "certify.json").read_text(), parse_constant=pytest.fail)
    assert set(result) >= {"found_after_m", "look_alikes", "area_m2"} and result["found_after_m"]["5"] == 0.0
    assert all(set(pair) == {"a", "b", "log_odds"} and len(pair["a"]) == 3 for pair in result["look_alikes"])
    assert "look alike" in printed and "report.html" in printed
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Can a robot be found in twins?" in page and 'data-key="5" data-value="0.0"' in page
    assert (tmp_path / "out" / "certify.png").read_bytes()[:4] == b"\x89PNG"
    assert json.loads(call("--out", str(tmp_path / "out"), "--json")) == result


@pytest.mark.parametrize(
    ("words", "message"),
    [(("--fov", "400"), "--fov 400"), (("--beams", "0"), "--beams 0"), (("--range", "-1"), "--range -1")],
)
def test_lidars_that_cannot_be(call, tmp_path, words, message, capsys):
    with pytest.raises(SystemExit) as stop:
        call("--out", str(tmp_path / "out"), *words)
    assert stop.value.code == 2 and message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_lidar_of_three_numbers():
    lidar = certify.lidar_from_args(certify.CertifyArgs(None, None, fov=270.0, range=12.0, beams=361))
    assert lidar.angles()[[0, -1]] == pytest.approx([-0.75 * math.pi, 0.75 * math.pi], abs=1e-5)
    turn = certify.lidar_from_args(certify.CertifyArgs(None, None, fov=360.0, range=12.0, beams=360))
    assert turn.angle_increment == pytest.approx(math.radians(1))


def test_a_map_without_room(tmp_path, monkeypatch, capsys):
    cells = np.ones((8, 8), bool)
    cells[4, 4] = False
    save_ros_map(from_cells(cells, resolution=0.25), tmp_path / "m.yaml")
    monkeypatch.setattr(sys, "argv", ["certify", "--map", str(tmp_path / "m.yaml"), "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as stop:
        run_cli(certify.main)
    assert stop.value.code == 2 and "m.yaml: the map has no free cell" in capsys.readouterr().err
