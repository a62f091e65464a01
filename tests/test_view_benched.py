"""The page of bench: its numbers are those of bench.json, its pictures those of the worst runs."""

from __future__ import annotations

import json
import math
import re
from html import unescape

import numpy as np
import pytest

import made_bench
from dsom_jax.judging.by_drive import worst_run
from dsom_jax.view import benched, sketch
from dsom_jax.view.localized import plan_of

MARKED = re.compile(r'data-key="([^"]+)" data-value="([^"]+)">([^<]+)<')


@pytest.fixture(scope="module")
def made():
    return made_bench.made()


@pytest.fixture(scope="module")
def html(made):
    suite, _, data, worst = made
    return benched.render_benchmark(suite, data, worst)


def looked_up(data, key):
    for part in unescape(key).split("."):
        data = data[int(part)] if isinstance(data, list) else data[part]
    return data


def test_numbers_on_the_page_are_those_of_bench_json(html, made):
    data = json.loads(json.dumps(made[2], allow_nan=False))
    seen = {}
    for key, value, shown in MARKED.findall(html):
        seen[unescape(key)] = looked_up(data, key)
        assert float(value) == seen[unescape(key)] and shown != "–"
    wanted = ("converged", "steps_median", "retention", "strict_success", "e_pos_m")
    for name in made_bench.METHODS:
        for phase in ("global", "kidnap"):
            entry = data["methods"][name][phase]
            for key in wanted:
                assert (f"methods.{name}.{phase}.{key}" in seen) == (entry[key] is not None)
            for bounds in ("converged_ci95", "retention_ci95", "strict_success_ci95", "e_pos_ci95"):
                there = entry[bounds.replace("pos_ci95", "pos_m").removesuffix("_ci95")] is not None
                for n, bound in enumerate(entry[bounds]):
                    told = f"methods.{name}.{phase}.{bounds}.{n}" in seen
                    assert told == (there and bound is not None)
            for n in range(6):
                assert f"methods.{name}.by_drive.{n}.{phase}.converged" in seen
    assert data["methods"][made_bench.METHODS[-1]]["global"]["converged"] == 0
    for key in ("suite", "seed", "runs", "particles", "digests.drives", "digests.maps.test-0"):
        assert f'<td data-number="{key}">{looked_up(data, key)}</td>' in html


def test_a_drive_by_itself_adds_up_to_the_method(made):
    for entry in made[2]["methods"].values():
        for phase in ("global", "kidnap"):
            parts = [part[phase] for part in entry["by_drive"]]
            found = sum(part["converged"] * part["experiments"] for part in parts)
            assert sum(part["experiments"] for part in parts) == entry[phase]["experiments"]
            assert found / entry[phase]["experiments"] == pytest.approx(entry[phase]["converged"])
            off = sum((part["e_pos_m"] or 0) * part["converged"] * part["experiments"] for part in parts)
            assert not found or off / found == pytest.approx(entry[phase]["e_pos_m"])


def test_the_worst_run_is_the_one_that_a_loop_finds(made):
    suite, given, data, worst = made
    for name, replies in given.items():
        for n, (_, _, episode) in enumerate(suite.episodes):
            truth, found = np.asarray(episode.poses, float), []
            for run, poses in enumerate(replies[n].poses):
                off = [math.dist(p[:2], q[:2]) for p, q in zip(poses, truth, strict=True)]
                turn = [abs(math.remainder(p[2] - q[2], 2 * math.pi)) for p, q in zip(poses, truth, strict=True)]
                right = sum(a < 2 and b < math.radians(10) for a, b in zip(off, turn, strict=True)) / len(truth)
                found.append((right, -off[-1], run))
            right, off, run = min(found)
            told = data["methods"][name]["by_drive"][n]["worst"]
            assert told["run"] == worst[name][n].run == run
            assert told["right"] == pytest.approx(right) and told["e_pos_m"] == pytest.approx(-off, abs=1e-4)
            np.testing.assert_array_equal(worst[name][n].poses, replies[n].poses[run])


def test_the_worst_of_runs_without_reference_or_answer():
    poses, nothing = np.zeros((3, 4, 3)), np.full((3, 4), np.nan)
    unjudged = worst_run(poses, nothing, nothing)
    assert unjudged.run == 0 and math.isnan(unjudged.right) and not unjudged.wrong.any()
    off = np.full((3, 4), 0.1)
    off[1, 1] = off[2, 1] = np.inf
    off[:, 3], off[0, 2], off[1, 2] = np.nan, 1.9, 0.2  # the last update has no reference
    worst = worst_run(poses, off, np.zeros((3, 4)))
    assert (worst.run, worst.right, worst.e_pos_m) == (1, 2 / 3, 0.2) and worst.wrong.tolist() == [0, 1, 0, 0]


def test_the_page_is_small_and_needs_nothing_else(html):
    assert len(html.encode()) < 1_000_000
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\(|<script", html)
    asked = set(re.findall(r'(?:src|href)\s*=\s*"([^"]*)"', html)) - {"data:,"}
    assert all(address.startswith("#") for address in asked)
    assert {address[1:] for address in asked} <= set(re.findall(r'\bid="([^"]+)"', html))


def test_a_picture_for_every_drive_and_method(html, made):
    assert len(re.findall(r'<li id="worst-\d+-\d+">', html)) == 60 and html.count("<h2>Drive") == 6
    assert len(re.findall(r'<circle class="taken"', html)) == 6  # drives share their path
    assert html.count('<path class="walls"') == 2  # and buildings
    assert "<amcl>" not in html and "&lt;amcl&gt; &amp; &#x27;others&#x27;" in html
    links = re.findall(r'<a href="#(worst-\d+-\d+)"', html)
    assert len(links) == 60 + 20  # each of the drives, and the worst of each method in each phase
    name = made_bench.METHODS[4]
    parts = [part["worst"] for part in made[2]["methods"][name]["by_drive"]]
    number = min(range(6), key=lambda n: (parts[n]["right"], -parts[n]["e_pos_m"]))
    assert links[4] == f"worst-{number + 1}-5"


def test_long_drives_are_thinned(made):
    suite, _, data, _ = made
    rng, poses = np.random.default_rng(1), np.cumsum(np.full((200_000, 3), 1e-4), 0)
    moved = np.arange(len(poses)) == 70_000
    sheet = sketch.sheet_of(plan_of(suite.episodes[0][1], suite.lidar, ""))
    # Wrong and jumping about all the time: as long as it gets.
    lost = worst_run(rng.uniform(0, 40, (1, len(poses), 3)), np.full((1, len(poses)), 9.0), np.zeros((1, len(poses))))
    right = worst_run(poses[None], np.zeros((1, len(poses))), np.zeros((1, len(poses))))
    for worst in (lost, right):
        assert len(sketch.run_drawing(worst, moved, sheet, 300)) < 12_000
    assert right.poses.shape == poses.shape and len(data["methods"]) == 10


def test_maps_are_drawn_where_they_are(made):
    suite, _, _, _ = made
    _, grid, episode = suite.episodes[0]
    plan = plan_of(grid, suite.lidar, "")
    sheet = sketch.sheet_of(plan)
    rectangles = re.findall(r"M(\d+) (\d+)h(\d+)v(\d+)", sketch._rectangles(plan.occupied))
    cells = np.zeros_like(plan.occupied)
    for j, i, width, height in (map(int, r) for r in rectangles):
        assert not cells[i : i + height, j : j + width].any()
        cells[i : i + height, j : j + width] = True
    np.testing.assert_array_equal(cells, plan.occupied)
    # The matrix takes cells to where the points of the map frame go.
    a, b, c, d, e, f = map(float, re.search(r"matrix\(([^)]+)\)", sketch.map_drawing(plan, sheet)).group(1).split())
    j, i = np.asarray(grid.to_grid(episode.poses))[:, :2].T / grid.resolution
    drawn = np.stack([a * j + c * i + e, b * j + d * i + f], -1)
    np.testing.assert_allclose(drawn, sheet.points(np.asarray(episode.poses)[:, :2]), atol=1.5)
