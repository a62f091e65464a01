"""Pages: what is in them, how large they are, and that they need nothing else."""

from __future__ import annotations

import base64
import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import made_story
from dsom_jax.view import Field, Lookalike, Story, render, trajectory_figure
from dsom_jax.view.page import readable
from dsom_jax.view.story import fewer_particles, moments

DATA = re.compile(r'<script type="application/json" id="story">(.*?)</script>', re.S)


@pytest.fixture(scope="module")
def html():
    return render(made_story.story())


def unpacked(html):
    return json.loads(DATA.search(html).group(1))


def numbers(text, kind):
    return np.frombuffer(base64.b64decode(text), kind)


def test_a_page_is_small_and_needs_nothing_else(html):
    assert len(html.encode()) < 1_000_000
    # An address of a namespace would be one, too; nothing is fetched from anywhere but the page itself.
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\(", html)
    sources = re.findall(r'(?:src|href)\s*=\s*"([^"]*)"', html)
    assert set(sources) <= {"data:,", "#player"}


def test_many_drives_share_the_room(html):
    page = render(made_story.story(*(made_story.drive(f"segment {n}", n) for n in range(8))))
    assert len(page.encode()) < 1_400_000
    assert [d["name"] for d in unpacked(page)["drives"]] == [f"segment {n}" for n in range(8)]


def test_what_is_packed_is_what_was_told(html):
    data, drive = unpacked(html), made_story.drive()
    (packed,) = data["drives"]
    np.testing.assert_allclose(numbers(packed["estimates"], "<f4").reshape(-1, 3), drive.estimates, atol=1e-5)
    np.testing.assert_allclose(numbers(packed["errorPosition"], "<f4"), drive.errors()[0], atol=1e-5)
    assert [data["verdicts"][v] for v in numbers(packed["verdict"], "u1")] == list(drive.verdicts)
    assert packed["kidnapped"] == [made_story.CARRIED] and packed["particles"]["count"] == made_story.PARTICLES
    quantum, steps = data["quantum"], numbers(packed["particles"]["xy"], "<i2").reshape(-1, made_story.PARTICLES, 2)
    found = steps * quantum["scale"] + [quantum["x"], quantum["y"]]
    np.testing.assert_allclose(found, drive.particles[..., :2], atol=quantum["scale"])
    codes = numbers(packed["ranges"], "<u2").reshape(drive.ranges.shape)
    assert ((codes == 65535) == np.isinf(drive.ranges)).all()
    seen = np.isfinite(drive.ranges)
    np.testing.assert_allclose(codes[seen] * data["range"], drive.ranges[seen], atol=1e-3)
    counts, rows = numbers(packed["hypotheses"]["counts"], "<u2"), numbers(packed["hypotheses"]["rows"], "<f4")
    assert set(counts) == {1, 3} and len(rows) == 8 * counts.sum()
    np.testing.assert_allclose(rows[:8], [0.55, *drive.estimates[0], 0.09, 0, 0.02, 0.01], atol=1e-5)


def test_the_map_is_upright(html):
    image = unpacked(html)["map"]["png"].removeprefix("data:image/png;base64,")
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(image))))[::-1]
    plan = made_story.plan()
    assert ((pixels == 255) == plan.occupied).all() and ((pixels == 128) == plan.free).all()


def test_corners_of_what_is_known():
    plan = made_story.plan()
    corners = plan.corners() - plan.origin[:2]
    np.testing.assert_allclose(np.hypot(*corners[1]), 33.0)
    np.testing.assert_allclose(np.arctan2(*corners[1][::-1]), 0.2)
    empty = replace(plan, occupied=np.zeros((4, 6), bool), free=np.zeros((4, 6), bool))
    assert len(empty.corners()) == 4


def test_moments_worth_a_look():
    found = moments(made_story.drive())
    assert found == sorted(found) and [m.update for m in found if m.kind == "kidnapping"] == [made_story.CARRIED]
    # One stretch of four updates that are sure and wrong: its first update alone.
    assert [m.update for m in found if m.kind == "sure and wrong"] == [made_story.CARRIED]
    e_pos, _ = made_story.drive().errors()
    worst = [m.update for m in found if m.kind == "worst"]
    assert int(np.argmax(e_pos)) in worst and len(worst) == 2  # all others are small
    unjudged = moments(made_story.drive(reference=False))
    assert {m.kind for m in unjudged} == {"kidnapping", "worst"}


def test_fewer_particles_keep_the_shares():
    drive = made_story.drive()
    heavy = np.full(drive.particle_weights.shape, 1e-6)
    heavy[:, 7], heavy[:, 300] = 0.75, 0.25
    poses, weights = fewer_particles(replace(drive, particle_weights=heavy), 100)
    assert poses.shape == (made_story.UPDATES, 100, 3) and (weights == 0.01).all()
    share = (poses == drive.particles[:, 7:8]).all(-1).mean(1)
    np.testing.assert_allclose(share, 0.75, atol=0.011)  # strata of one hundredth
    for given, own in zip(fewer_particles(drive, 500), (drive.particles, drive.particle_weights), strict=True):
        np.testing.assert_array_equal(given, own)  # where there are no more, they are left alone


def test_numbers_on_the_page_are_those_of_the_summary(html):
    for key, value in re.findall(r'data-key="(\w+)" data-value="([^"]+)"', html):
        assert float(value) == made_story.SUMMARY[key]
    assert len(re.findall("data-key=", html)) == len(made_story.TILES)
    assert '<td data-number="kidnap.converged">0.95</td>' in html


@pytest.mark.parametrize(
    ("value", "kind", "text"),
    [
        (0.9625, "percent", "96.2 %"), (0.0, "percent", "0.0 %"), (0.00042, "percent", "0.042 %"),
        (0.0487, "metres", "0.049 m"), (12.34, "metres", "12.3 m"), (7.0, "count", "7"), (None, "percent", "–"),
        (float("nan"), "metres", "–"),
    ],
)  # fmt: skip
def test_numbers_as_people_read_them(value, kind, text):
    assert readable(value, kind).replace("\u00a0", " ") == text


def test_text_of_a_log_cannot_break_out(html):
    assert html.count("</script>") == 2 and "&lt;/script&gt;" in html
    page = render(made_story.story(made_story.drive("</script><b>drive")))
    assert page.count("</script>") == 2 and unpacked(page)["drives"][0]["name"] == "</script><b>drive"


def test_without_reference_nothing_is_judged():
    page = render(made_story.story(made_story.drive(reference=False)))
    assert unpacked(page)["drives"][0]["truth"] is None
    figure = trajectory_figure(made_story.plan(), made_story.drive(reference=False))
    assert len(figure.axes) == 2 and len(trajectory_figure(made_story.plan(), made_story.drive()).axes) == 3


def test_a_map_alone():
    plan = made_story.plan()
    layer = Field("until found", "m", np.where(plan.free, 5.0, np.nan), plan.origin, plan.resolution)
    layer.values[40, 40] = 0.0
    pair = Lookalike(np.array([1.0, 2, 0]), np.array([3.0, 4, np.pi]), 0.25)
    page = render(Story("Map", "headline", plan, overlay=layer, lookalikes=(pair,)))
    data = unpacked(page)
    assert (data["overlay"]["low"], data["overlay"]["high"], data["drives"]) == (0.0, 5.0, [])
    assert data["lookalikes"] == [{"a": [1.0, 2.0, 0.0], "b": [3.0, 4.0, 3.1416]}]
    assert "3.0 m, 4.0 m, 180°" in page and "0.25" in page


def test_stories_that_do_not_fit_together():
    drive = made_story.drive()
    with pytest.raises(ValueError, match=r"DriveStory\.p_lost: 119 updates, stamps have 120"):
        replace(drive, p_lost=drive.p_lost[1:])
    with pytest.raises(ValueError, match="'sure' is none of localized"):
        replace(drive, verdicts=("sure",) * 120)
