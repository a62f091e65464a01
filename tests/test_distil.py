"""How the paper's network begins: with another's weights, and by imitating its SIM."""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax import checkpoint
from dsom_jax.errors import UserError
from dsom_jax.nn import DSOMConfig, create, evaluation_view
from dsom_jax.nn.polar import Conditions
from dsom_jax.training.batches import Batch, ScanConfig
from dsom_jax.training.loop import TrainConfig, split_model

FOLDER = Path(__file__).resolve().parents[1] / "experiments" / "dsom"


@pytest.fixture(scope="module")
def distil():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER)
        import distil

        yield distil
        del sys.modules["distil"]


def networks():
    shared = {"width": 2, "headings": 4}
    return create(DSOMConfig(**shared, encoder="paper"), 0), create(DSOMConfig(**shared, channels=2, panorama=True), 1)


def test_it_begins_with_the_map_encoder_and_the_decoder_of_the_teacher(distil):
    student, teacher = networks()
    own = np.asarray(student.scan.stages[0].blocks[0].kernel[...])
    new = distil.begun(student, teacher)
    for block in (lambda m: m.environment.stages[1].blocks[2].kernel, lambda m: m.decoder.head.kernel):
        np.testing.assert_array_equal(block(new)[...], block(teacher)[...])
    # The panorama's four headings come after the four of the coarse SIM; the paper's network has none.
    wide, narrow = teacher.decoder.stages[0].blocks[0].kernel[...], new.decoder.stages[0].blocks[0].kernel[...]
    assert wide.shape[2] == 8 and narrow.shape[2] == 4
    np.testing.assert_array_equal(narrow, wide[:, :, :4])
    np.testing.assert_array_equal(new.scan.stages[0].blocks[0].kernel[...], own)


def test_no_buffer_is_shared_with_the_teacher(distil):
    """The step gives away the student's buffers."""
    student, teacher = networks()
    mine, given = (
        {x.unsafe_buffer_pointer() for x in jax.tree.leaves(split_model(m)[1:])}
        for m in (distil.begun(student, teacher), teacher)
    )
    assert len(mine) > 50 and not mine & given


def test_who_is_the_teacher_has_nothing_to_imitate(distil):
    model = evaluation_view(networks()[0])
    config = TrainConfig(model=model.config, scan=ScanConfig(beams=24))
    room = jnp.zeros((2, 16, 16), bool).at[:, 0].set(True).at[1, 8, 4:].set(True)
    ranges = jax.random.uniform(jax.random.key(0), (2, 3, 24), maxval=8.0)
    poses = jax.random.uniform(jax.random.key(1), (2, 3, 3), minval=1.0, maxval=4.0)
    batch = Batch(room, ~room, ranges, Conditions(jnp.full((2, 3), 10.0), jnp.full((2, 3), 0.26)), poses)
    found = distil.losses(model, batch, config, model)
    assert float(found.likeness) == pytest.approx(1.0, abs=1e-4)
    other = distil.losses(evaluation_view(create(model.config, 5)), batch, config, model)
    assert float(other.likeness) < 0.9 and float(other.imitated) > float(found.imitated)
    for one in (found, other):
        expected = distil.LIKENESS * (1 - one.likeness) + one.imitated + one.similarity
        assert float(one.total) == pytest.approx(float(expected), rel=1e-6)


def test_imitation_does_not_see_scale_and_level_in_the_likeness_but_in_the_softmax(distil):
    given = 3 * jax.random.normal(jax.random.key(0), (2, 3, 4, 5, 6))
    like, entropy = distil.imitation(given, given)
    truth = np.asarray(jax.nn.softmax(given.reshape(6, -1), axis=-1), np.float64)
    assert float(like) == pytest.approx(1.0, abs=1e-5)
    assert float(entropy) == pytest.approx(-(truth * np.log(truth)).sum(-1).mean(), rel=1e-5)
    like, flatter = distil.imitation(0.5 * given + 7.0, given)
    assert float(like) == pytest.approx(1.0, abs=1e-4) and float(flatter) > float(entropy)
    assert float(distil.imitation(-given, given)[0]) == pytest.approx(-1.0, abs=1e-5)


def test_every_scan_is_standardised_alone(distil):
    x = jnp.stack([jnp.arange(8.0), 100 - 5 * jnp.arange(8.0)]).reshape(1, 2, 2, 2, 2)
    out = np.asarray(distil.standard(x)).reshape(2, 8)
    expected = (np.arange(8) - 3.5) / np.sqrt(((np.arange(8) - 3.5) ** 2).sum())
    np.testing.assert_allclose(out, [expected, -expected], atol=1e-4)


def test_a_teacher_of_another_size_is_refused(distil, tmp_path):
    checkpoint.save(tmp_path, networks()[1])
    config = TrainConfig(model=DSOMConfig(width=3, headings=4, encoder="paper", reach_min=5.0))
    with pytest.raises(UserError, match=r"model\.width is 2, the run's is 3"):
        distil.read_teacher(tmp_path, config)
