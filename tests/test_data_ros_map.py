"""Maps of map_server: literal pixels, every mode, the round trip, and each way in which a map can be broken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from dsom_jax.data.log import Report
from dsom_jax.data.ros_map import (
    MapInfo,
    Picture,
    decode_image,
    load_ros_map,
    occupancy_percent,
    read_map_info,
    save_ros_map,
)
from dsom_jax.errors import UserError
from dsom_jax.occupancy import OccupancyGrid, cell_index, from_cells

FIELDS = {
    "image": "map.pgm",
    "resolution": "0.05",
    "origin": "[-1.0, -2.0, 0.5]",
    "negate": "0",
    "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}
PIXELS = np.array([[0, 205, 254], [254, 254, 0]], np.uint8)
"""Top row: wall, unknown, free; bottom row: free, free, wall."""


def write(folder: Path, pixels: np.ndarray = PIXELS, **changes: str | None) -> Path:
    """A map in ``folder`` with fields changed, or left out where None."""
    fields = FIELDS | changes
    name = fields["image"] or "map.pgm"
    Image.fromarray(pixels).save(folder / name)
    path = folder / "map.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in fields.items() if value is not None))
    return path


def test_rows_are_flipped_and_cells_named(tmp_path: Path) -> None:
    grid = load_ros_map(write(tmp_path))
    # Row 0 is the bottom of the image.
    np.testing.assert_array_equal(grid.occupied, [[0, 0, 1], [1, 0, 0]])
    np.testing.assert_array_equal(grid.free, [[1, 1, 0], [0, 0, 1]])
    assert grid.resolution == 0.05


def test_origin_yaw_is_honoured(tmp_path: Path) -> None:
    grid = load_ros_map(write(tmp_path, origin="[10.0, 20.0, 1.5707963267948966]"))
    # Turned by 90 deg, columns run along map y and rows along -map x: the centre of cell (1, 2) is 2.5 pixels up in y
    # and 1.5 pixels left in x of the lower-left corner.
    i, j = cell_index(grid, np.array([10.0 - 1.5 * 0.05, 20.0 + 2.5 * 0.05, 0.0]))
    assert (int(i), int(j)) == (1, 2)


@pytest.mark.parametrize(
    ("unknown", "occupied", "free"),
    [("blocked-for-robot", False, False), ("opaque", True, False), ("free", False, True)],
)
def test_what_unknown_cells_are(tmp_path: Path, unknown: str, occupied: bool, free: bool) -> None:
    grid = load_ros_map(write(tmp_path), unknown=unknown)
    assert bool(grid.occupied[1, 1]) is occupied
    assert bool(grid.free[1, 1]) is free


@pytest.mark.parametrize(
    ("changes", "told"),
    [({"free_thresh": "0.25"}, True), ({}, False), ({"free_thresh": "0.25", "mode": "scale"}, False),
     ({"free_thresh": "0.25", "negate": "1"}, False)],
)  # fmt: skip
def test_map_savers_grey_that_is_free_is_told(tmp_path: Path, changes: dict, told: bool) -> None:
    """nav2's map_saver writes unknown as 205, which its own default threshold takes for free."""
    report = Report()
    grid = load_ros_map(write(tmp_path, **changes), report=report)
    assert any("1 pixels of grey 205" in line and "0.196" in line for line in report.lines()) is told
    # The semantics stay nav2's, whatever is told.
    assert "negate" in changes or bool(grid.free[1, 1]) is ("free_thresh" in changes)


def test_a_map_in_survey_coordinates_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"map.yaml: lies at \(3500000, 5400000\) m .* single precision"):
        load_ros_map(write(tmp_path, origin="[3.5e6, 5.4e6, 0]"))


def test_unknown_must_be_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="blocked-for-robot"):
        load_ros_map(write(tmp_path), unknown="grey")


def info(mode: str, **changes: object) -> MapInfo:
    return MapInfo(**({"image": Path("m"), "resolution": 1.0, "origin": (0.0, 0.0, 0.0), "occupied_thresh": 0.65,
                       "free_thresh": 0.196, "negate": False, "mode": mode} | changes))  # fmt: skip


# Pixel, percentage with negate 0, with negate 1; thresholds 0.65 and 0.196: occupancy of 205 is 0.19608, just unknown.
@pytest.mark.parametrize(
    ("mode", "pixel", "plain", "negated"),
    [
        ("trinary", 0, 100, 0),
        ("trinary", 89, 100, -1),
        ("trinary", 90, -1, -1),
        ("trinary", 205, -1, 100),
        ("trinary", 206, 0, 100),
        ("trinary", 255, 0, 100),
        ("scale", 0, 100, 0),
        ("scale", 128, 67, 67),
        ("scale", 205, 0, 100),
        ("scale", 255, 0, 100),
        ("raw", 0, 0, 0),
        ("raw", 37, 37, 37),
        ("raw", 100, 100, 100),
        ("raw", 101, -1, -1),
        ("raw", 255, -1, -1),
    ],
)
def test_percentages_of_each_mode(mode: str, pixel: int, plain: int, negated: int) -> None:
    picture = Picture(np.array([[pixel]], np.uint8), 255)
    assert occupancy_percent(picture, info(mode))[0, 0] == plain
    assert occupancy_percent(picture, info(mode, negate=True))[0, 0] == negated


@given(
    pixel=st.integers(0, 255),
    thresholds=st.tuples(st.integers(0, 99), st.integers(1, 100)).filter(lambda t: t[0] < t[1]),
    negate=st.booleans(),
)
@settings(max_examples=200, deadline=None)
def test_thresholds_against_exact_arithmetic(pixel: int, thresholds: tuple[int, int], negate: bool) -> None:
    free, occupied = thresholds
    # Occupancy is n / 255, thresholds are hundredths: compare 100 n with 255 t in integers.
    n = pixel if negate else 255 - pixel
    expected = 0 if 100 * n <= 255 * free else 100 if 100 * n >= 255 * occupied else -1
    fields = info("trinary", free_thresh=free / 100, occupied_thresh=occupied / 100, negate=negate)
    assert occupancy_percent(Picture(np.array([[pixel]], np.uint8), 255), fields)[0, 0] == expected


@given(
    cells=hnp.arrays(np.int8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12), elements=st.integers(0, 2)).filter(
        lambda cells: (cells == 1).any()
    ),
    resolution=st.floats(0.01, 1.0),
    origin=st.tuples(st.floats(-100, 100), st.floats(-100, 100), st.floats(-3.1, 3.1)),
)
@settings(max_examples=40, deadline=None)
def test_round_trip(tmp_path_factory, cells: np.ndarray, resolution: float, origin: tuple) -> None:
    grid = from_cells(cells == 0, cells == 1, resolution=resolution, origin=origin)
    path = tmp_path_factory.mktemp("map") / "saved.yaml"
    save_ros_map(grid, path)
    again = load_ros_map(path)
    assert_same(again, grid)
    assert sorted(p.name for p in path.parent.iterdir()) == ["saved.pgm", "saved.yaml"]


def assert_same(a: OccupancyGrid, b: OccupancyGrid) -> None:
    np.testing.assert_array_equal(a.occupied, b.occupied)
    np.testing.assert_array_equal(a.free, b.free)
    np.testing.assert_array_equal(a.origin, b.origin)
    assert a.resolution == b.resolution


def test_alpha_is_unknown_in_trinary_and_scale_only(tmp_path: Path) -> None:
    pixels = np.full((1, 3, 4), 255, np.uint8)
    pixels[0, 1, 3] = 128
    pixels[0, 2, :3] = 0
    for mode, free in (("trinary", [1, 0, 0]), ("scale", [1, 0, 0]), ("raw", [0, 0, 1])):
        grid = load_ros_map(write(tmp_path, pixels, image="map.png", mode=mode))
        np.testing.assert_array_equal(grid.free[0], free)


@pytest.mark.parametrize("image", ["grey8.png", "grey16.png", "colour.png", "grey8.bmp"])
def test_images_of_every_kind_agree(tmp_path: Path, image: str) -> None:
    pixels: np.ndarray = PIXELS
    if image == "grey16.png":
        pixels = PIXELS.astype(np.uint16) * 257
    elif image == "colour.png":
        pixels = np.repeat(PIXELS[..., None], 3, axis=-1)
    assert_same(load_ros_map(write(tmp_path, pixels, image=image)), load_ros_map(write(tmp_path)))


@pytest.mark.parametrize(
    "content",
    [
        b"P2\n# made by hand\n3 2 # wide\n255\n0 205 254\n254 254 0\n",
        b"P5 3 2 255\n\x00\xcd\xfe\xfe\xfe\x00",
        b"P5\n#c\n#d\n3 2\n255\n\x00\xcd\xfe\xfe\xfe\x00",
        b"P5\n3 2\n65535\n" + (PIXELS.astype(np.uint16) * 257).astype(">u2").tobytes(),
        b"P2\n3 2\n65535\n" + b" ".join(b"%d" % (int(v) * 257) for v in PIXELS.ravel()),
        b"P5\n3 2\n510\n" + (PIXELS.astype(np.uint16) * 2).astype(">u2").tobytes(),
        b"P2\n3 2\n51\n0 41 51 51 51 0\n",
    ],
)
def test_every_pgm_gives_the_same_map(tmp_path: Path, content: bytes) -> None:
    path = write(tmp_path)
    expected = load_ros_map(path)
    (tmp_path / "map.pgm").write_bytes(content)
    assert_same(load_ros_map(path), expected)


def test_pgm_pixels_that_look_like_white_space_survive(tmp_path: Path) -> None:
    pixels = np.array([[10, 32, 13], [35, 9, 255]], np.uint8)
    (tmp_path / "m.pgm").write_bytes(b"P5 3 2 255\n" + pixels.tobytes())
    np.testing.assert_array_equal(decode_image(tmp_path / "m.pgm").pixels, pixels)


def test_numbers_as_ros_writes_them(tmp_path: Path) -> None:
    # YAML 1.1 takes 5e-2 for a string; true and false are as good as 1 and 0.
    fields = read_map_info(write(tmp_path, resolution="5e-2", negate="true", mode="Scale"))
    assert (fields.resolution, fields.negate, fields.mode) == (0.05, True, "scale")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"image": None}, "field 'image' is missing"),
        ({"resolution": None}, "field 'resolution' is missing"),
        ({"negate": None}, "field 'negate' is missing"),
        ({"resolution": "0"}, "resolution = 0: must be a number of metres"),
        ({"resolution": "-0.05"}, "resolution = -0.05: must be a number of metres"),
        ({"resolution": ".nan"}, "resolution = nan: must be a number of metres"),
        ({"resolution": "fine"}, "resolution = 'fine': must be a number"),
        ({"origin": "[0, 0]"}, "origin = .*three numbers"),
        ({"origin": "7"}, "origin = 7: must be three numbers"),
        ({"origin": "[0, 0, .inf]"}, "origin = .*three numbers"),
        ({"origin": "[0, 0, .nan]"}, "origin = .*three numbers"),
        ({"negate": "maybe"}, "negate = 'maybe': must be 0 or 1"),
        ({"free_thresh": "0.7"}, "free_thresh = 0.7, occupied_thresh = 0.65: need"),
        ({"occupied_thresh": "1.5"}, "occupied_thresh = 1.5: must be a number from 0 to 1"),
        ({"mode": "binary"}, "mode = 'binary': must be one of trinary"),
        ({"negate": "1", "free_thresh": "0.0"}, "negate"),
    ],
)
def test_bad_fields(tmp_path: Path, changes: dict, message: str) -> None:
    path = write(tmp_path, np.full((2, 2), 254, np.uint8), **changes)
    with pytest.raises(UserError, match=message) as error:
        load_ros_map(path)
    assert "map.yaml" in str(error.value) and "\n" not in str(error.value)


def test_bad_files(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"nowhere.yaml: no such map yaml"):
        load_ros_map(tmp_path / "nowhere.yaml")
    with pytest.raises(UserError, match="is a directory"):
        load_ros_map(tmp_path)
    path = tmp_path / "map.yaml"
    for text, message in (("a: [1\nb: }", "not valid YAML at line"), ("- 1\n- 2\n", "no fields"), ("", "no fields")):
        path.write_text(text)
        with pytest.raises(UserError, match=message):
            load_ros_map(path)
    path.write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(UserError, match="not text in UTF-8"):
        load_ros_map(path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("map.pgm", None, "no such map image"),
        ("map.pgm", b"P5 what", "not a readable image"),
        ("map.pgm", b"P5\n3 2\n255\nabc", "truncated"),
        ("map.pgm", b"P2\n3 2\n255\n1 2 x 4 5 6", "not a readable image"),
        ("map.pgm", b"P2\n3 2\n255\n1 2", "not a readable image"),
        ("map.pgm", b"P5\n3 2\n0\nabcdef", "not a readable image"),
        ("map.pgm", b"P5\n" + 5000 * b"9" + b" 2\n255\nabcdef", "not a readable image"),
        ("map.pgm", b"P5\n30000 30000\n255\nabc", "too large .*100,000,000 pixels"),
        ("map.png", b"", "not a readable image"),
        ("map.png", b"no image at all", "not a readable image"),
    ],
)
def test_bad_images(tmp_path: Path, capfd, name: str, content: bytes | None, message: str) -> None:
    path = write(tmp_path, image=name)
    (tmp_path / name).unlink() if content is None else (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=f"{name}: .*{message}"):
        load_ros_map(path)
    assert capfd.readouterr().err == ""


def test_map_without_free_space(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no free cell"):
        load_ros_map(write(tmp_path, np.zeros((3, 3), np.uint8)))


def test_save_into_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    grid = from_cells(np.zeros((2, 2), bool), resolution=1.0)
    with pytest.raises(UserError, match="cannot be written"):
        save_ros_map(grid, tmp_path / "file" / "map.yaml")
