"""Ray casting against every-ray-with-every-cell, and the table against the exact method."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax import marching, raycast
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig
from dsom_jax.marching import empty_squares, empty_wedges
from dsom_jax.occupancy import from_cells
from dsom_jax.raycast import RaycastConfig, make_tables
from reference import rays

cast_rays = jax.jit(raycast.cast_rays, static_argnums=2)
EXACT = RaycastConfig("exact")
WEDGES = RaycastConfig("exact", wedges=3, max_skip=30)
CELLS = 2e-3  # promised accuracy, and the clearance of corners below which no side can be told
FAN = LidarConfig(beams=37, angle_min=-3.1, angle_increment=0.17, range_max=12.0)
FOUR = LidarConfig(beams=4, angle_min=-math.pi, angle_increment=math.pi / 2, range_max=10.0)  # back, right, ahead, left

ROOM = np.array(
    [
        [1, 1, 1, 1, 1, 1, 1],
        [1, 0, 0, 0, 0, 0, 1],
        [1, 0, 0, 1, 0, 0, 1],
        [1, 0, 0, 0, 0, 0, 1],
        [1, 1, 1, 1, 1, 1, 1],
    ],
    bool,
)


def rooms() -> np.ndarray:
    """Two rooms with a door, pillars and a slanted wall, 80 x 80 cells: what a building looks like to the table."""
    cells = np.zeros((80, 80), bool)
    cells[[0, -1]] = cells[:, [0, -1]] = True
    cells[:, 40] = True
    cells[30:38, 40] = False
    cells[15:18, 15:18] = cells[60:62, 20:22] = cells[50:53, 60:63] = True
    for j in range(42, 70):
        cells[5 + j // 4, j] = True
    return cells


@pytest.fixture(scope="module")
def house():
    """Tables of :func:`rooms` by both methods, cells of 0.1 m."""
    grid = from_cells(rooms(), resolution=0.1)
    configs = {"exact": EXACT, "table": RaycastConfig("table"), "fine": RaycastConfig("table", viewpoints=3)}
    return {name: make_tables(grid, config, 12.0) for name, config in configs.items()}


def random_map(seed: int, shape=(31, 45), density=0.06) -> np.ndarray:
    return np.random.default_rng(seed).random(shape) < density


def random_poses(seed: int, shape: tuple[int, ...], size: tuple[float, float]) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([rng.uniform(0, size[0], shape), rng.uniform(0, size[1], shape), rng.uniform(-4, 4, shape)], -1)


def assert_like_reference(ranges, occupied, resolution, origin, sensors, angles, range_max):
    """Every ray that passes no corner within CELLS is within CELLS; returns the share of rays compared."""
    compared = []
    for row, sensor in zip(np.asarray(ranges).reshape(-1, len(angles)), sensors.reshape(-1, 3), strict=True):
        expected, clearance = rays.scan(occupied, resolution, origin, sensor, angles)
        expected[expected >= range_max] = np.inf
        sure = (clearance > CELLS) & ~(np.abs(expected - range_max) < CELLS * resolution)
        np.testing.assert_allclose(row[sure], expected[sure], atol=CELLS * resolution, rtol=1e-6)
        compared.append(sure.mean())
    return np.mean(compared)


def test_room_by_hand():
    tables = make_tables(from_cells(ROOM, resolution=0.5), EXACT, 10.0)
    # In the middle of cell (1, 1); and left of the pillar on (2, 3), looking up (+y).
    poses = jnp.array([[0.75, 0.75, 0.0], [1.3, 1.2, math.pi / 2]])
    by_hand = np.array([[0.25, 0.25, 2.25, 1.25], [0.7, 0.2, 0.8, 0.8]])  # back, right, ahead, left
    np.testing.assert_allclose(cast_rays(tables, poses, FOUR), by_hand, atol=1e-3)
    # Beams that end half a cell (0.25 m) deep in the walls.
    scanned = make_tables(from_cells(ROOM, resolution=0.5), RaycastConfig(surface=0.5), 10.0)
    np.testing.assert_allclose(cast_rays(scanned, poses, FOUR), by_hand + 0.25, atol=1e-3)
    # What is farther than range_max is no return.
    near = replace(FOUR, range_max=0.75)
    expected = np.where(by_hand < 0.75, by_hand, np.inf)
    np.testing.assert_allclose(cast_rays(tables, poses, near), expected, atol=1e-3)
    expected = np.where(by_hand + 0.25 < 0.75, by_hand + 0.25, np.inf)
    np.testing.assert_allclose(cast_rays(scanned, poses, near), expected, atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("density", [0.01, 0.15])
@pytest.mark.parametrize("method", [EXACT, WEDGES], ids=["squares", "wedges"])
def test_random_maps_against_the_slow_reference(seed, density, method):
    occupied = random_map(seed, density=density)
    origin = (-3.0, 5.0, 0.6 * seed)
    grid = from_cells(occupied, resolution=0.2, origin=origin)
    poses = np.asarray(grid.from_grid(jnp.asarray(random_poses(seed, (11,), (9.0, 6.2)), jnp.float32)))
    ranges = cast_rays(make_tables(grid, method, FAN.range_max), poses, FAN)
    share = assert_like_reference(ranges, occupied, 0.2, origin, poses, FAN.angles(), FAN.range_max)
    assert share > 0.9


@pytest.mark.parametrize("method", [EXACT, WEDGES], ids=["squares", "wedges"])
def test_long_corridor_with_grazing_rays(method):
    # 300 cells long and 3 wide: hundreds of leaps along the wall.
    occupied = np.ones((5, 300), bool)
    occupied[1:4, 1:-1] = False
    lidar = LidarConfig(beams=41, angle_min=-0.02, angle_increment=0.001, range_max=40.0)
    poses = np.array([[0.15, 0.27, 0.0], [0.3, 0.12, 0.0], [0.155, 0.2513, 0.001]])
    tables = make_tables(from_cells(occupied, resolution=0.1), method, 40.0)
    ranges = np.asarray(cast_rays(tables, jnp.asarray(poses, jnp.float32), lidar))
    for pose, row in zip(poses, ranges, strict=True):
        # A float32 angle is off by 3e-7 rad; at 1e-2 rad of incidence and 25 m that is worth a millimetre.
        turned = [
            rays.scan(occupied, 0.1, (0, 0, 0), pose, lidar.angles().astype(float) + a)[0] for a in (-3e-7, 0, 3e-7)
        ]
        tolerance = np.abs(np.array(turned) - turned[1]).max(0) + CELLS * 0.1
        assert (np.abs(row - turned[1]) <= tolerance).mean() > 0.95  # the others pass a corner within rounding
    assert ranges.max() == pytest.approx(29.9 - 0.15, abs=1e-3)


def test_diagonal_pillars():
    occupied = np.eye(40, dtype=bool)
    lidar = LidarConfig(beams=90, angle_min=-1.55, angle_increment=0.035, range_max=100.0)
    poses = random_poses(4, (9,), (40.0, 40.0))
    ranges = cast_rays(make_tables(from_cells(occupied, resolution=1.0), EXACT, 100.0), jnp.asarray(poses), lidar)
    assert assert_like_reference(ranges, occupied, 1.0, (0.0, 0.0, 0.0), poses, lidar.angles(), 100.0) > 0.8


def test_open_space_returns_nothing():
    empty = make_tables(from_cells(np.zeros((31, 45), bool), resolution=0.2), EXACT, FAN.range_max)
    poses = random_poses(0, (11,), (9.0, 6.2)).astype(np.float32)
    poses[:2, :2] = [[0.0, 0.0], [8.999, 6.199]]
    assert np.isposinf(cast_rays(empty, poses, FAN)).all()


@pytest.mark.parametrize("method", ["exact", "table", "fine"])
def test_poses_outside_in_walls_and_nan(method, house):
    outside = [[-0.1, 1.0, 0.0], [1.0, 8.1, 0.0], [1e9, 0.0, 0.0], [-5.0, -5.0, 1.0]]
    unknown = [[np.nan, 1.0, 0.0], [1.0, np.nan, 0.0], [1.0, 1.0, np.nan]]
    walls = [[0.02, 0.02, 0.1], [4.06, 2.0, 2.0], [1.6, 1.7, -1.0], [7.99, 5.0, 0.5]]
    ranges = np.asarray(cast_rays(house[method], jnp.array(outside + unknown + walls), FAN))
    assert np.isposinf(ranges[:7]).all()
    np.testing.assert_array_equal(ranges[7:], 0.0)


def test_mounted_sensor():
    occupied = random_map(7)
    grid = from_cells(occupied, resolution=0.2)
    lidar = LidarConfig(beams=19, angle_min=-1.0, angle_increment=0.13, mount=(0.4, -0.3, 2.0), upside_down=True)
    base = random_poses(7, (6,), (8.0, 5.0))
    ranges = cast_rays(make_tables(grid, EXACT, 10.0), jnp.asarray(base, jnp.float32), lidar)
    c, s = np.cos(base[:, 2]), np.sin(base[:, 2])
    sensors = np.stack([base[:, 0] + c * 0.4 + s * 0.3, base[:, 1] + s * 0.4 - c * 0.3, base[:, 2] + 2.0], -1)
    bearings = -(-1.0 + 0.13 * np.arange(19))  # head down: clockwise
    assert assert_like_reference(ranges, occupied, 0.2, (0.0, 0.0, 0.0), sensors, bearings, 10.0) > 0.9


@pytest.mark.parametrize("method", ["exact", "table", "fine"])
def test_batches_of_any_shape_give_the_same_rays(method, house):
    poses = jnp.asarray(random_poses(5, (65,), (8.0, 8.0)), jnp.float32)
    flat = cast_rays(house[method], poses, FAN)  # 65 * 37 rays, not a multiple of 64
    assert flat.shape == (65, FAN.beams)
    # Compiled code may contract multiplications and additions: the last bits differ.
    same = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5)
    same(cast_rays(house[method], poses[64], FAN), flat[64])
    mapped = jax.jit(jax.vmap(lambda p: raycast.cast_rays(house[method], p, FAN)))
    same(mapped(poses[:60].reshape(2, 30, 3)), flat[:60].reshape(2, 30, -1))


@pytest.mark.parametrize("mapped", ["squares", "x", "bearings", "limit"])
def test_a_march_may_be_mapped_over_any_of_its_arguments(mapped):
    squares = np.stack([empty_squares(jnp.asarray(np.pad(random_map(s, (9, 9)), 1, constant_values=True)), 7)
                        for s in range(2)])  # fmt: skip
    arguments = {
        "squares": squares, "x": np.array([[1.2, 6.3], [4.4, 7.5]]), "y": np.array([2.5, 6.5]),
        "theta": np.array([0.3, -2.0]), "bearings": np.array([[0.0, 1.7], [0.9, 3.0]]), "limit": np.array([3.0, 9.0]),
    }  # fmt: skip
    first = {name: v if name in ("y", "theta", mapped) else v[0] for name, v in arguments.items()}
    march = jax.jit(raycast.march)
    together = jax.jit(jax.vmap(raycast.march, [0 if name == mapped else None for name in first]))(*first.values())
    for n, row in enumerate(np.asarray(together)):
        alone = {name: v[n] if name == mapped else v for name, v in first.items()}
        np.testing.assert_allclose(row, march(*alone.values()), rtol=1e-5, atol=1e-5)
    assert np.isfinite(together).any() and not np.array_equal(*np.asarray(together))


def test_worlds_made_inside_of_jit():
    poses = jnp.asarray(random_poses(2, (11,), (9.0, 6.2)), jnp.float32)

    def world_and_scan(key):
        occupied = jax.random.bernoulli(key, 0.1, (31, 45))
        return occupied, raycast.cast_rays(
            raycast.make_tables(from_cells(occupied, resolution=0.2), EXACT, 12.0), poses, FAN
        )

    cells, ranges = jax.jit(jax.vmap(world_and_scan))(jax.random.split(jax.random.key(0), 3))
    for occupied, got in zip(np.asarray(cells), ranges, strict=True):
        tables = make_tables(from_cells(occupied, resolution=0.2), EXACT, 12.0)
        np.testing.assert_allclose(got, cast_rays(tables, poses, FAN), rtol=1e-5, atol=1e-5)


def test_empty_squares_by_brute_force():
    blocked = random_map(9, (12, 15), 0.1)
    sides = np.asarray(empty_squares(jnp.asarray(blocked), 5))
    for layer, (up, right) in enumerate([(False, False), (False, True), (True, False), (True, True)]):
        for i in range(12):
            for j in range(15):
                side = 0
                for n in range(1, 6):
                    rows = slice(i, i + n) if up else slice(max(i - n + 1, 0), i + 1)
                    cols = slice(j, j + n) if right else slice(max(j - n + 1, 0), j + 1)
                    side = n if not blocked[rows, cols].any() else side
                assert sides[layer, i, j] == side, (up, right, i, j)


@pytest.mark.parametrize("sectors", [1, 3])
def test_empty_wedges_by_rays_from_all_over_the_cell(sectors):
    # Border and all, as the march has it; no ray of a sector may meet a wall in the columns promised.
    blocked = np.pad(random_map(4, (16, 19), 0.06), 1, constant_values=True)
    cap = 9
    wedges = np.asarray(empty_wedges(jnp.asarray(blocked), sectors, cap))
    assert wedges.shape == (8 * sectors, *blocked.shape)
    assert (wedges[:, blocked] == 0).all() and (wedges[:, ~blocked] > 0).all() and wedges.max() <= cap + 1
    rng, longest = np.random.default_rng(0), 0
    for layer, promised in enumerate(wedges):
        octant, sector = divmod(layer, sectors)
        steep, up, right = octant // 4, 1 if octant % 4 // 2 else -1, 1 if octant % 2 else -1
        for i, j in rng.permutation(np.argwhere(~blocked))[:60]:
            columns = int(promised[i, j]) - 1
            longest = max(longest, columns)
            for _ in range(30):
                slope = (sector + rng.random()) / sectors
                direction = np.array([slope, 1.0] if steep else [1.0, slope]) * (right, up)
                start = np.array([j, i]) + rng.random(2)
                way = start + np.arange(0.001, cap + 2, 0.01)[:, None] * direction
                crossed = np.abs(np.floor(way[:, 1 if steep else 0]) - (i if steep else j))
                cells = np.floor(way[crossed < columns]).astype(int)
                assert not blocked[cells[:, 1], cells[:, 0]].any(), (layer, i, j)
    assert longest > 4  # so that there was something to be wrong about


def test_wedges_of_a_bare_hall_by_hand():
    blocked = np.ones((5, 9), bool)
    blocked[1:4, 1:8] = False
    ahead = np.asarray(empty_wedges(jnp.asarray(blocked), 4, 20))
    # Along x towards up and right (octant 3), slopes below 1/4: from the lowest row at the left a ray climbs to just
    # below 1 + 8/4 = 3 rows within 7 columns, and the wall is behind the seventh; one row up it may hit the ceiling.
    assert ahead[3 * 4, 1, 1] == 1 + 7
    assert ahead[3 * 4, 3, 1] == 1  # the ceiling is met in the own column
    assert ahead[2 * 4, 1, 7] == 1 + 7  # the same to the left


def test_wedges_take_no_more_memory_than_allowed(monkeypatch):
    occupied = jnp.asarray(random_map(1, (30, 30), 0.1))
    monkeypatch.setattr(raycast, "_MOST", 2 * 8 * 32 * 32)
    assert raycast.leaps(occupied, RaycastConfig(wedges=5)).shape == (2 * 8, 32, 32)
    assert raycast.leaps(occupied, RaycastConfig(wedges=1, max_skip=255)).shape == (8, 32, 32)
    monkeypatch.setattr(raycast, "_MOST", 1)
    assert raycast.leaps(occupied, RaycastConfig(wedges=5)).shape == (8, 32, 32)


def test_table_against_exact(house):
    lidar = LidarConfig(beams=72, angle_increment=2 * math.pi / 72)
    rng = np.random.default_rng(0)
    i, j = np.nonzero(np.asarray(house["exact"].grid.free))
    chosen = rng.integers(0, len(i), 400)
    xy = (np.stack([j, i], -1)[chosen] + rng.random((400, 2))) * 0.1
    poses = jnp.asarray(np.concatenate([xy, rng.uniform(-np.pi, np.pi, (400, 1))], -1), jnp.float32)
    exact, *tables = (np.asarray(cast_rays(house[method], poses, lidar)) for method in ("exact", "table", "fine"))
    assert not np.isnan([exact, *tables]).any()
    with np.errstate(invalid="ignore"):  # no return in both
        error, finer = (np.nan_to_num(np.abs(table - exact) / 0.1) for table in tables)
    # The tabulated wall is the right one for most rays, and the actual ray then meets it exactly. Measured here:
    # 2.7 % are off by more than half a cell (it and the ray of the cell's centre meet different walls), 1.2 % by five.
    assert np.median(error) < 1e-3
    assert (error > 0.5).mean() < 0.035
    assert (error > 5).mean() < 0.018
    # A third as far from the viewpoint, a third as many rays on the other side of an edge, but for the directions.
    assert (finer > 0.5).mean() < 0.5 * (error > 0.5).mean() and (finer > 5).mean() < 0.5 * (error > 5).mean()


def test_nothing_is_retraced():
    chex.clear_trace_counter()
    cast = jax.jit(chex.assert_max_traces(lambda tables, poses: raycast.cast_rays(tables, poses, FAN), n=1))
    for seed in range(3):
        tables = make_tables(from_cells(random_map(seed), resolution=0.2), EXACT, 12.0)
        cast(tables, jnp.asarray(random_poses(seed, (4,), (9.0, 6.0)), jnp.float32))


@pytest.mark.parametrize(
    ("fields", "said"),
    [(dict(method="fast"), "'exact' or 'table'"), (dict(angles=2), "angles = 2: give at least 4"),
     (dict(max_skip=0), "max_skip"),
     (dict(max_skip=300), "max_skip")],
)  # fmt: skip
def test_bad_configuration_is_refused(fields, said):
    with pytest.raises(ValueError, match=said):
        RaycastConfig(**fields)


@pytest.mark.parametrize("bearing", [-5e-17, 5e-17, -5e-10])
@pytest.mark.parametrize("heading", [0.0, -math.pi])
def test_bearings_that_rounding_leaves_a_little_off_the_axis(bearing, heading):
    """-0.3 + 3 * 0.1 is not zero in float64; the direction of such a ray is no multiple of float32's usual step."""
    tables = make_tables(from_cells(ROOM, resolution=1.0), EXACT, 10.0)
    lidar = LidarConfig(beams=1, angle_min=bearing, range_max=10.0)
    (reach,) = cast_rays(tables, jnp.array([2.5, 1.5, heading]), lidar)
    assert float(reach) == pytest.approx(3.5 if heading == 0.0 else 1.5, abs=CELLS)


def test_a_wall_of_one_cell_on_a_map_of_more_cells_than_float32_counts():
    squares = np.ones((4, 4200, 4200), np.uint8)  # of one cell each, so that nothing has to be searched for
    squares[:, 4190, 4001] = 0
    x, y = jnp.array([3990.25, 4010.25]), jnp.array([4189.5, 4189.5])
    reach = marching.march(jnp.asarray(squares), x, y, jnp.array([0.0, math.pi]), jnp.zeros(1), 30.0)
    # The squares have a border of one cell: the wall lies from 4000 to 4001.
    np.testing.assert_allclose(reach[:, 0], [9.75, 9.25], atol=CELLS)


@pytest.mark.parametrize("shape", [(2000, 3000), (1, 2**14)])
def test_maps_too_large_for_a_table_are_refused(shape):
    grid = from_cells(np.zeros(shape, bool), resolution=0.05)
    with pytest.raises(UserError, match="too large for a table"):
        make_tables(grid, RaycastConfig("table"), 10.0)


def test_viewpoints_count_towards_the_size_of_a_table():
    grid = from_cells(np.zeros((1000, 2000), bool), resolution=0.05)
    with pytest.raises(UserError, match="too large for a table"):
        make_tables(grid, RaycastConfig("table", viewpoints=2), 10.0)
