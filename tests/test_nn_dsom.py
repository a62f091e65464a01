"""DSOM as a whole: shapes, map sizes, where probability may go, and use inside jit, vmap and scan."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from dsom_jax.lidar import LidarConfig
from dsom_jax.nn import DSOMConfig, create, encode_map, evaluation_view, log_probability_map

LIDAR = LidarConfig(beams=36, angle_increment=2 * np.pi / 36)
CONFIGS = {
    "polar": DSOMConfig(width=2, headings=4),
    "panorama": DSOMConfig(width=2, headings=4, panorama=True),
    "paper": DSOMConfig(width=2, headings=4, encoder="paper", paper_head=True),
}


def walls(shape, seed=0):
    return jax.random.uniform(jax.random.key(seed), shape) < 0.2


@partial(jax.jit, static_argnames="lidar")
def probability_map(model, occupied, free, scan, lidar=LIDAR):
    return log_probability_map(model, encode_map(model, occupied, free), scan, lidar)


def ranges(seed=0, *batch):
    return jax.random.uniform(jax.random.key(seed), (*batch, 36), maxval=11.0)


@pytest.fixture(scope="module", params=CONFIGS)
def model(request):
    return evaluation_view(create(CONFIGS[request.param], seed=1))


@pytest.mark.parametrize("shape", [(16, 24), (17, 9)])
def test_any_map_size_and_only_free_cells(model, shape):
    occupied = walls(shape)
    free = ~occupied & walls(shape, 1)
    pm = jnp.exp(probability_map(model, occupied, free, ranges()))
    assert pm.shape == (*shape, 4)
    np.testing.assert_allclose(pm.sum(), 1.0, rtol=1e-5)
    assert (pm[~free] == 0).all() and (pm[free] > 0).all()


def test_padding_changes_nothing_but_the_cut(model):
    occupied = walls((16, 16)).at[:, 11:].set(False)
    log_whole = probability_map(model, occupied, ~occupied, ranges())[:, :11]
    log_cut = probability_map(model, occupied[:, :11], ~occupied[:, :11], ranges())
    finite = jnp.isfinite(log_cut)
    difference = jnp.where(finite, log_whole - log_cut, 0.0)
    shift = difference.sum() / finite.sum()  # the share of the columns cut off
    np.testing.assert_allclose(jnp.where(finite, difference - shift, 0.0), 0.0, atol=1e-4)


def test_inside_jit_vmap_and_scan(model):
    features = jax.jit(encode_map)(model, walls((16, 16)))
    scans = ranges(3, 3)
    one = jax.jit(lambda r: log_probability_map(model, features, r, LIDAR))
    expected = jnp.stack([one(r) for r in scans])
    np.testing.assert_allclose(jnp.exp(jax.vmap(one)(scans)), jnp.exp(expected), rtol=1e-4, atol=1e-6)
    _, scanned = jax.lax.scan(lambda carry, r: (carry, one(r)), 0, scans)
    np.testing.assert_allclose(jnp.exp(scanned), jnp.exp(expected), rtol=1e-4, atol=1e-6)


def test_all_invalid_scan_gives_a_proper_map(model):
    occupied = walls((16, 24))
    pm = jnp.exp(probability_map(model, occupied, ~occupied, jnp.full(36, jnp.nan)))
    np.testing.assert_allclose(pm.sum(), 1.0, rtol=1e-5)


def test_paper_head_floors_the_logits_and_a_linear_one_does_not():
    x = 50 * jax.random.normal(jax.random.key(0), (2, 8, 8, 2))
    floors = {n: float(create(CONFIGS[n]).decoder.head(x).min()) for n in ("paper", "polar")}
    assert floors["paper"] >= -1.0 and floors["polar"] < -1.5


def test_widths_of_the_paper():
    stages = nnx.eval_shape(lambda: create(DSOMConfig(width=64, encoder="paper"))).environment.stages
    channels = [block.kernel.shape[-1] for stage in stages for block in stage.blocks]
    assert channels == [64, 64, 128, 128, 128, 256, 256, 256, 256]
