"""Checkpoints: what is loaded is what was saved, and everything that can be wrong gives one clear line."""

from __future__ import annotations

import json
import math
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from dsom_jax import checkpoint
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig
from dsom_jax.nn import DSOMConfig, create

CONFIG = DSOMConfig(width=2, headings=4, fov_min=math.pi)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    directory = tmp_path_factory.mktemp("checkpoint") / "dsom"
    checkpoint.save(directory, create(CONFIG, seed=3), {"seed": 3, "metrics": {"top1": 0.5}})
    return directory


@pytest.fixture
def copy(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "copy")


def edit(directory, **fields):
    path = directory / checkpoint.PROVENANCE
    path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))


def leaves(model):
    return jax.tree.leaves(nnx.as_pure(nnx.state(model, nnx.Any(nnx.Param, nnx.BatchStat))))


def test_round_trip(saved):
    loaded = checkpoint.load(saved, LidarConfig(), CONFIG.resolution)
    assert loaded.config == CONFIG
    assert loaded.decoder.stages[0].blocks[0].norm.use_running_average
    for ours, theirs in zip(leaves(loaded), leaves(create(CONFIG, seed=3)), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    record = checkpoint.load_provenance(saved)
    assert record["seed"] == 3 and record["metrics"]["top1"] == 0.5 and "jax" in record["packages"]


def test_half_precision_is_half_the_size_and_read_as_single(saved, tmp_path):
    checkpoint.save(tmp_path, create(CONFIG, seed=3), half=True)
    loaded = leaves(checkpoint.load(tmp_path))
    for ours, theirs in zip(loaded, leaves(create(CONFIG, seed=3)), strict=True):
        assert ours.dtype == jnp.float32
        # Eleven bits of mantissa; below 2^-14 steps are 2^-24.
        np.testing.assert_allclose(ours, theirs, rtol=2**-11, atol=2**-25)


def test_saving_again_replaces_and_leaves_one_folder(copy):
    checkpoint.save(copy, create(CONFIG, seed=4), tag="weights-2")
    assert [p.name for p in copy.glob("weights*")] == ["weights-2"]
    np.testing.assert_array_equal(leaves(checkpoint.load(copy))[0], leaves(create(CONFIG, seed=4))[0])


def test_state_round_trip(tmp_path):
    state = {"a": jnp.arange(3), "b": (jnp.float32(2.5), jnp.ones((2, 2), jnp.int8))}
    checkpoint.save_state(tmp_path / "state", state)
    restored = checkpoint.load_state(tmp_path / "state", state)
    assert jax.tree.structure(restored) == jax.tree.structure(state)
    jax.tree.map(np.testing.assert_array_equal, restored, state)


def test_missing_folder(tmp_path):
    with pytest.raises(UserError, match=r"nowhere.*provenance\.json.*no such file"):
        checkpoint.load(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"format": 99}, "field format"),
        ({"model": {"colour": 1}}, "field model"),
        ({"model": {"width": 0}}, "field model: width"),
        ({"model": {"width": 4, "headings": 4}}, "weights are damaged or of another configuration|weights .* where"),
        ({"weights": "elsewhere"}, "folder of the weights is missing"),
    ],
)
def test_wrong_fields(copy, fields, message):
    edit(copy, **fields)
    with pytest.raises(UserError, match=message):
        checkpoint.load(copy)


def test_not_json(copy):
    (copy / checkpoint.PROVENANCE).write_text("{half")
    with pytest.raises(UserError, match=r"provenance\.json: not JSON"):
        checkpoint.load(copy)


def test_missing_field(copy):
    (copy / checkpoint.PROVENANCE).write_text('{"format": 1, "weights": "weights"}')
    with pytest.raises(UserError, match="field model is missing"):
        checkpoint.load(copy)


def test_damaged_weights(copy):
    for path in (copy / "weights").rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    with pytest.raises(UserError, match="weights are damaged"):
        checkpoint.load(copy)


def test_wrong_lidar_or_scale(saved):
    with pytest.raises(UserError, match="does not fit the lidar: field of view 90 deg"):
        checkpoint.load(saved, LidarConfig(beams=90))
    with pytest.raises(UserError, match="resample the map"):
        checkpoint.load(saved, resolution=0.05)


def test_unwritable(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write the checkpoint"):
        checkpoint.save(tmp_path / "file" / "x", create(CONFIG))


SHIPPED = sorted(checkpoint.SHIPPED.parent.iterdir())


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_what_is_shipped_loads_and_says_how_it_came_about(folder):
    record = json.loads((folder / "provenance.json").read_text())
    kind = record.get("kind", "dsom")
    weights = jax.tree.leaves(checkpoint.load(folder, kind=kind))
    assert weights and all(np.isfinite(np.asarray(x)).all() for x in weights)
    assert len(record["commit"]) == 40 and record["steps"] > 0 and record["samples"] > 0 and record["metrics"]
    assert [path.name for path in folder.iterdir() if path.is_dir()] == [record["weights"]]
    # Orbax writes down where it saved; that is no path of the machine it was trained on.
    assert not any(b"/" in path.read_bytes() for path in folder.rglob("commit_success.txt"))


def test_networks_for_full_turns_refuse_half_of_one():
    half = LidarConfig(180, -math.pi / 2, math.radians(1), 0.0, 10.0)
    with pytest.raises(UserError, match="field of view 180 deg, trained for 360 or more"):
        checkpoint.load(checkpoint.SHIPPED.with_name("dsom-paper"), half)


def test_what_is_shipped_is_small():
    sizes = [path.stat().st_size for folder in SHIPPED for path in folder.rglob("*") if path.is_file()]
    assert len(SHIPPED) == 4 and sum(sizes) < 40e6
