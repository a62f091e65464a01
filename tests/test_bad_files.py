"""Maps, drawings, logs and tables of the kinds that once ended in a traceback, in memory, or in silence.

Each ends in one line that names the file, the field and the fix; made here, with the readers alone.
"""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dsom_jax.data import load_log, load_map, load_ros_map
from dsom_jax.data.cut import thin
from dsom_jax.data.log import Report
from dsom_jax.data.suite import decode
from dsom_jax.data.trajectory import with_reference
from dsom_jax.errors import UserError
from dsom_jax.judging.run_table import read_runs
from dsom_jax.lidar import LidarConfig
from dsom_jax.report import output_folder
from fuzz import seeds
from fuzz.run import fuzz
from tiny_drawing import ROOM, room, write

FIELDS = {"image": "map.pgm", "resolution": "0.05", "origin": "[0.0, 0.0, 0.0]", "negate": "0",
          "occupied_thresh": "0.65", "free_thresh": "0.196"}  # fmt: skip
PIXELS = np.array([[0, 0, 0, 0], [0, 254, 254, 0], [0, 254, 254, 0], [0, 0, 0, 0]], np.uint8)


def ros_map(folder: Path, extra: str = "", **changes: str) -> Path:
    Image.fromarray(PIXELS).save(folder / "map.pgm")
    (folder / "map.yaml").write_text("".join(f"{k}: {v}\n" for k, v in (FIELDS | changes).items()) + extra)
    return folder / "map.yaml"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"origin": "'123'"}, r"origin = '123': must be three numbers \[x, y, yaw\]"),
        ({"origin": "{0: 1, 1: 2, 2: 3}"}, "origin = .*three numbers"),
        ({"origin": "[1, 2, 90]"}, r"origin = \[1, 2, 90\]: .*radians.*90 deg is 1.5708"),
        ({"origin": "[0, 0, 1e300]"}, "origin = .*radians"),
        ({"origin": "[0, 0, '0']"}, "origin = .*three numbers"),
        ({"origin": "[0, 0, true]"}, "origin = .*three numbers"),
        ({"origin": "[" + "9" * 400 + ", 0, 0]"}, "line 3: a number of 400 digits"),
        ({"origin": "[1e200, 0, 0]"}, "origin = .*three numbers"),
        ({"resolution": "yes"}, "resolution = 'yes': must be a number of metres"),
        ({"resolution": "010"}, "resolution = '010': must be a number of metres"),
        ({"resolution": "true"}, "resolution = True: must be a number of metres"),
        ({"resolution": "2020-13-45"}, "resolution = '2020-13-45': must be"),
        ({"resolution": "9" * 5000}, "a number of 5000 digits"),
        ({"image": '"a\\0b.pgm"'}, "no file has such a name"),
        ({"image": "a" * 300 + ".pgm"}, "no file has such a name .*characters"),
        ({"image": "/dev/zero"}, "is a device or a pipe, not a map image"),
        ({"image": "."}, "is a directory"),
        ({"image": "[a, b]"}, "image = .*the name of the picture"),
        ({"image": "''"}, "image = '': must be the name of the picture"),
        ({"negate": "2"}, "negate = 2: must be 0 or 1"),
        ({"mode": "3"}, "mode = 3: must be one of trinary"),
    ],
    ids=lambda part: "" if isinstance(part, str) else " ".join(f"{k}={v[:20]}" for k, v in part.items()),
)
def test_fields_of_map_yamls(tmp_path, changes, message):
    with pytest.raises(UserError, match=message) as error:
        load_map(ros_map(tmp_path, **changes))
    assert "field 'image'" in str(error.value) or "map.yaml" in str(error.value)


def test_keys_stand_once(tmp_path):
    with pytest.raises(UserError, match="line 7: field 'resolution' stands twice"):
        load_map(ros_map(tmp_path, "resolution: 0.1\n"))


def test_the_picture_beside_a_yaml_that_travelled(tmp_path):
    for told in ("/home/somebody/catkin_ws/src/map/map.pgm", "'C:\\maps\\map.pgm'", "maps/map.pgm"):
        report = Report()
        grid = load_ros_map(ros_map(tmp_path, image=told), report=report)
        assert int(grid.free.sum()) == 4
        assert any("map.pgm beside the yaml is taken" in line for line in report.lines())
    report = Report()
    load_ros_map(ros_map(tmp_path), report=report)
    assert report.lines() == []
    with pytest.raises(UserError, match=r"/home/somebody/other\.pgm: no such map image"):
        load_map(ros_map(tmp_path, image="/home/somebody/other.pgm"))


@pytest.mark.parametrize("mode", ["trinary", "scale"])
def test_equal_thresholds_are_those_of_map_server(tmp_path, mode):
    grid = load_map(ros_map(tmp_path, free_thresh="0.5", occupied_thresh="0.5", mode=mode))
    assert int(grid.free.sum()) == 4 and int(grid.occupied.sum()) == 12


def test_yaw_beyond_half_a_turn_is_said(tmp_path):
    report = Report()
    load_ros_map(ros_map(tmp_path, origin="[0, 0, 5]"), report=report)
    assert any("origin yaw of 5 is taken for radians, 286 deg" in line for line in report.lines())


@pytest.mark.parametrize("suffix", ["jpg", "png", "bmp", "tif", "webp", "gif"])
def test_pictures_that_are_cut_off(tmp_path, suffix, capfd):
    picture = np.kron(PIXELS, np.ones((40, 40), np.uint8))
    picture[::7, ::3] = 254
    path = ros_map(tmp_path, image=f"map.{suffix}")
    Image.fromarray(picture).save(tmp_path / f"map.{suffix}")
    load_map(path)
    content = (tmp_path / f"map.{suffix}").read_bytes()
    for keep in (0.9, 0.5, 0.05):
        (tmp_path / f"map.{suffix}").write_bytes(content[: int(keep * len(content))])
        with warnings.catch_warnings(), pytest.raises(UserError, match=rf"map\.{suffix}: not a readable image"):
            warnings.simplefilter("error")
            load_map(path)
    assert capfd.readouterr() == ("", "")


def test_a_png_whose_pixels_were_changed(tmp_path):
    path = ros_map(tmp_path, image="map.png")
    Image.fromarray(PIXELS).save(tmp_path / "map.png")
    content = bytearray((tmp_path / "map.png").read_bytes())
    content[content.index(b"IDAT") + 12] ^= 1
    (tmp_path / "map.png").write_bytes(content)
    with pytest.raises(UserError, match=r"map\.png: not a readable image"):
        load_map(path)


@pytest.mark.parametrize("suffix", ["png", "pgm"])
def test_pictures_without_measure(tmp_path, suffix):
    path = ros_map(tmp_path, image=f"map.{suffix}")
    if suffix == "png":
        Image.fromarray(PIXELS).save(tmp_path / "map.png")
        content = bytearray((tmp_path / "map.png").read_bytes())
        at = content.index(b"IHDR")
        content[at + 4 : at + 12] = (30_000).to_bytes(4, "big") * 2
        import zlib

        content[at + 17 : at + 21] = zlib.crc32(content[at : at + 17]).to_bytes(4, "big")
        (tmp_path / "map.png").write_bytes(content)
    else:
        (tmp_path / "map.pgm").write_bytes(b"P5 30000 30000 255\n")
    with pytest.raises(UserError, match=r"map\.p.. *: is too large .*limit is 100,000,000 pixels"):
        load_map(path)


def test_arrays_of_blocks_without_limit(tmp_path):
    def array(msp):
        room(msp)
        msp.doc.blocks.new("TREE").add_line((0, 0), (1, 1))
        spread = {"column_count": 30_000, "row_count": 30_000, "column_spacing": 0.1, "row_spacing": 0.1}
        msp.add_blockref("TREE", (1, 1), dxfattribs=spread)

    with pytest.raises(UserError, match=r"plan.dxf: its blocks and arrays stand for 9.0e\+08 entities, the limit is"):
        load_map(write(tmp_path / "plan.dxf", array))


def test_blocks_in_blocks_without_limit(tmp_path):
    def nest(msp):
        room(msp)
        msp.doc.blocks.new("B0").add_line((0, 0), (1, 1))
        for n in range(1, 41):
            block = msp.doc.blocks.new(f"B{n}")
            block.add_blockref(f"B{n - 1}", (0, 0)), block.add_blockref(f"B{n - 1}", (1, 0))
        msp.add_blockref("B40", (1, 1), dxfattribs={"layer": "TREES"})

    path = write(tmp_path / "plan.dxf", nest)
    with pytest.raises(UserError, match=r"plan.dxf: its blocks and arrays stand for 1.1e\+12 entities"):
        load_map(path)
    (tmp_path / "plan.yaml").write_text("drawing: plan.dxf\nexclude: [TREES]\n")
    assert bool(load_map(tmp_path / "plan.yaml").free.any())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('drawing: "a\\0.dxf"', "no file has such a name"),
        ("drawing: plan.dxf\nresolution: " + "9" * 400, "a number of 400 digits"),
        ("drawing: plan.dxf\nstart: [" + "9" * 400 + ", 0]", "a number of 400 digits"),
        ("drawing: plan.dxf\nstart: [1e300, 0]", "start = .*outside"),
        ("drawing: plan.dxf\npose: [0, 0, 90]", "pose = .*radians"),
        ("drawing: plan.dxf\npose: [1e300, 0, 0]", "too far for single precision"),
        ("drawing: /dev/zero", "a device or a pipe"),
        ("drawing: pointer.dxf", "pointer.dxf: is a git-LFS pointer"),
    ],
    ids=lambda part: part[:30],
)
def test_yamls_of_drawings(tmp_path, text, message):
    write(tmp_path / "plan.dxf", room)
    (tmp_path / "pointer.dxf").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    (tmp_path / "plan.yaml").write_text(text)
    with warnings.catch_warnings(), pytest.raises(UserError, match=message):
        warnings.simplefilter("error")
        load_map(tmp_path / "plan.yaml")


def test_a_drawing_of_astronomic_size(tmp_path):
    def planets(msp):
        room(msp)
        msp.add_circle((0, 0), 1e9)

    with pytest.raises(UserError, match=r"plan.dxf: .*cells; check units"):
        load_map(write(tmp_path / "plan.dxf", planets))


def test_entities_that_are_broken_are_counted(tmp_path):
    def broken(msp):
        msp.add_lwpolyline(ROOM, close=True)
        msp.add_line((3, 0), (3, 2))

    path = write(tmp_path / "plan.dxf", broken)
    text = path.read_text()
    path.write_text(text.replace("AcDbLine", "AcDbLine\n 11\nnowhere", 1))
    try:
        load_map(path)
    except UserError as error:
        assert "plan.dxf" in str(error)


def carmen(folder: Path, spoil=lambda text: text, meta: str = "") -> Path:
    (folder / "drive.log").write_text(spoil(seeds.carmen("flaser")))
    if meta:
        (folder / "meta.yaml").write_text(meta)
    return folder / "drive.log"


@pytest.mark.parametrize("reading", ["3.4028234663852886e+38", "1e300", "1e154", "inf", "nan", "0", "-1"])
def test_readings_that_no_lidar_has(tmp_path, reading):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        log = load_log(carmen(tmp_path, lambda text: text.replace(" 1.10 ", f" {reading} ", 1)))
    assert len(log) == seeds.SCANS and log.lidar.range_max < 100
    beam = log.ranges[0, 1]
    assert np.isposinf(beam) if reading not in ("nan", "0", "-1") else np.isnan(beam)


@pytest.mark.parametrize(
    ("meta", "message"),
    [
        ("beams: '19'", "meta.yaml: beams = '19': must be the whole number of ranges"),
        ("beams: 18", "meta.yaml: beams = 18, but the scans .* 19: wrong lidar"),
        ("angle_increment: 0", "meta.yaml: angle_increment = 0: must be a finite number, not 0"),
        ("angle_increment: .nan", "meta.yaml: angle_increment = nan"),
        ("angle_increment: 10", "did you pass degrees|Did you pass degrees"),
        ("mount: [1.0e+300, 0, 0]", r"meta.yaml: mount = .*at most 100 m"),
        ("mount: [0, 0, 90]", r"meta.yaml: mount = \[0, 0, 90\]: .*radians.*1.5708"),
        ("mount: '123'", "meta.yaml: mount = '123': must be"),
        ("range_no_return: yes", "meta.yaml: range_no_return = 'yes': must be a number"),
        ("range_no_return: 1e300", "drive.log: need 0 <= range_min < range_max"),
        ("upside_down: 1", "meta.yaml: upside_down = 1: must be true or false"),
    ],
)
def test_descriptions_of_logs(tmp_path, meta, message):
    with pytest.raises(UserError, match=message):
        load_log(carmen(tmp_path, meta=meta))


def test_a_description_that_is_no_file(tmp_path):
    path = carmen(tmp_path)
    (tmp_path / "meta.yaml").mkdir()
    with pytest.raises(UserError, match=r"meta\.yaml: is a directory"):
        load_log(path)


@pytest.mark.parametrize("name", ["a" * 300 + ".log", "a\0.log", "a" * 300, "folder/" * 1000 + "a.bag"])
def test_names_that_no_log_can_have(name):
    for read in (load_log, load_map):
        with pytest.raises(UserError, match=r"no file has such a name \(\d+ characters\)"):
            read(name)


def test_lidars_that_cannot_be():
    for fields in ({"angle_increment": 0.0}, {"mount": (1e300, 0.0, 0.0)}, {"mount": (0.0, 0.0, 90.0)},
                   {"mount": (0.0, 0.0, math.nan)}, {"range_max": 1e300}, {"mount": (10**400, 0, 0)}):  # fmt: skip
        with pytest.raises(ValueError, match=next(iter(fields))):
            LidarConfig(**fields)


@pytest.mark.parametrize("far", [1e154, 1e155, 1e300])
def test_odometry_and_thresholds_beyond_all_measure(tmp_path, far):
    log = load_log(carmen(tmp_path))
    assert thin(log, update_min_d=far, update_min_a=far).tolist() == [0]
    log.odometry[5, 0] = far
    assert 5 in thin(log)


def reference(folder: Path, digits: int) -> Path:
    rows = [line.split() for line in seeds.tum().splitlines()]
    (folder / "ref.tum").write_text("".join(f"{float(row[0]):.{digits}g} {' '.join(row[1:])}\n" for row in rows))
    return folder / "ref.tum"


def test_a_reference_whose_stamps_have_too_few_digits(tmp_path):
    log = load_log(carmen(tmp_path))
    with pytest.raises(UserError, match=r"ref.tum: 2\d of 24 poses share their stamp .*at least 3 after the point"):
        with_reference(log, reference(tmp_path, 2))
    path = reference(tmp_path, 9)
    known = with_reference(log, path)
    assert np.isfinite(known.reference).all() and known.report.lines() == log.report.lines()
    rows = path.read_text().splitlines()
    path.write_text("\n".join([*rows, rows[3], rows[5].replace(" 0 0 0 ", " 0 0 0 9")]) + "\n")
    again = with_reference(load_log(tmp_path / "drive.log"), path)
    assert np.isnan(again.reference).any(-1).sum() <= 1
    assert any("2 poses of the reference dropped that share their stamp" in line for line in again.report.lines())


def test_a_reference_beyond_single_precision(tmp_path):
    (tmp_path / "ref.tum").write_text("100.5 3500000 5400000 0 0 0 0 1\n")
    with pytest.raises(UserError, match=r"ref.tum: lies at \(3500000, 5400000\) m"):
        with_reference(load_log(carmen(tmp_path)), tmp_path / "ref.tum")


def test_tables_and_suites_that_are_damaged(tmp_path):
    seeds.make(tmp_path)
    read_runs(tmp_path / "runs.npz")
    content = (tmp_path / "runs.npz").read_bytes()
    rng = np.random.default_rng(1)
    for _ in range(200):
        spoilt = bytearray(content)
        for at in rng.integers(len(content), size=3):
            spoilt[at] = rng.integers(256)
        (tmp_path / "runs.npz").write_bytes(spoilt)
        try:
            read_runs(tmp_path / "runs.npz")
        except UserError as error:
            assert "runs.npz" in str(error)
    for content in (b"not a zip", b"", (tmp_path / "suite.npz").read_bytes()[:-30]):
        with pytest.raises(UserError, match=r"suite mine: .*damaged"):
            decode("mine", content)


def test_a_folder_for_results_that_cannot_be():
    for name in ("a" * 300, "a\0b"):
        with pytest.raises(UserError, match=r"--out .*cannot write there"):
            output_folder(name)


def test_two_thousand_mutated_inputs():
    """As many again by ``python tests/fuzz/run.py --first N``; what once failed is kept below."""
    bench = fuzz(range(2000))
    assert bench.faults == [] and bench.outcomes["refused"] > 500 and bench.outcomes["loaded"] > 300
