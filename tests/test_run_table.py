"""Tables of runs: written, read, paired row by row, and from there to a verdict."""

from __future__ import annotations

import numpy as np
import pytest

from dsom_jax.errors import UserError
from dsom_jax.judging import statistics as s
from dsom_jax.judging.metrics import Runs, summarize
from dsom_jax.judging.run_table import join, paired, read_runs, run_rows, write_runs


def runs_of(steps, e_pos) -> Runs:
    """A phase of as many runs; half of the ten updates after convergence stayed."""
    steps, zero = np.asarray(steps), np.zeros(len(steps))
    after = np.where(steps >= 0, 10, 0)
    return Runs(steps, after, after // 2, steps < 0, np.asarray(e_pos, float), zero, zero + 20, zero, zero, zero, zero)


def made_up(better=-0.1) -> tuple:
    """Two methods on 8 sequences of 25 runs: b converges less often and errs more, everywhere."""
    rng, rows = np.random.default_rng(4), []
    for sequence in range(8):
        hard = rng.normal(0, 0.05)
        for method, shift, rate in (("a", better, 0.95), ("b", 0.0, 0.5)):
            steps = np.where(rng.uniform(size=25) < rate, rng.integers(0, 9, 25), -1)
            rows.append(
                run_rows(method, "global", sequence, 0, runs_of(steps, 0.5 + hard + shift + rng.normal(0, 0.02, 25)))
            )
    return tuple(rows)


def test_from_runs_to_a_verdict(tmp_path):
    # Rows need not be in order.
    table = join(made_up()[::-1])
    write_runs(tmp_path / "runs.npz", table)
    a, b = paired(read_runs(tmp_path / "runs.npz"), "a", "b", "global")
    assert (a.sequence == np.repeat(np.arange(8), 25)).all() and (a.run == np.tile(np.arange(25), 8)).all()
    assert a.method.tolist() == ["a"] * 200 and (np.isnan(a.retention) == ~a.converged).all()
    pieces = [
        s.paired_evidence("converged", a.converged, b.converged, a.sequence, "greater"),
        s.paired_evidence("E_pos, m", a.e_pos_m, b.e_pos_m, a.sequence),
        s.paired_evidence("retention", a.retention, b.retention, a.sequence, "greater"),
    ]
    assert [e.status() for e in pieces] == ["supports", "supports", "undecided"]
    assert pieces[1].estimate == pytest.approx(-0.1, abs=0.01) and pieces[1].low < -0.1 < pieces[1].high
    assert s.decide("a is better than b", pieces[:2]).outcome == "holds"
    other = s.paired_evidence("converged", b.converged, a.converged, a.sequence, "greater")
    assert s.decide("b is better than a", [other]).outcome == "does not hold here"
    # The table holds all that a summary asks for.
    assert summarize(a.runs)["retention"] == 0.5 and summarize(a.runs)["drives"] == 8


def test_the_parts_of_a_sequence_are_paired_with_each_other():
    """Two kidnappings of one sequence, of which one method's rows come the other way round."""
    rows = {
        (method, part): run_rows(method, "kidnap", 0, part, runs_of([part, -1], [10 * part + shift, shift]))
        for method, shift in (("a", 0.0), ("b", 0.5))
        for part in (0, 1)
    }
    table = join([rows[key] for key in (("a", 1), ("a", 0), ("b", 0), ("b", 1))])
    a, b = paired(table, "a", "b", "kidnap")
    assert a.part.tolist() == b.part.tolist() == [0, 0, 1, 1] and a.run.tolist() == b.run.tolist() == [0, 1, 0, 1]
    np.testing.assert_allclose(b.e_pos_m - a.e_pos_m, 0.5)
    assert a.steps.tolist() == [0, -1, 1, -1]
    np.testing.assert_array_equal(a.retention, [0.5, np.nan, 0.5, np.nan])
    with pytest.raises(ValueError, match="phase global"):
        paired(table, "a", "b", "global")


def test_tables_that_do_not_fit(tmp_path):
    rows = made_up()
    with pytest.raises(ValueError, match="same sequences and seeds"):
        paired(join(rows[:-1]), "a", "b", "global")
    with pytest.raises(ValueError, match="same sequences and seeds"):
        paired(join([*rows[:-1], rows[-1]._replace(sequence=rows[-1].sequence + 1)]), "a", "b", "global")
    with pytest.raises(ValueError, match=r"no run of c.*a, b"):
        paired(join(rows), "a", "c", "global")
    for name, content in (("words.npz", b"to be"), ("empty.npz", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError, match="not a table of runs"):
            read_runs(tmp_path / name)
    np.savez(tmp_path / "other.npz", x=1)
    with pytest.raises(UserError, match="not a table of runs"):
        read_runs(tmp_path / "other.npz")
    with pytest.raises(UserError, match="no such table"):
        read_runs(tmp_path / "nowhere.npz")
