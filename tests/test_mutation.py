"""The list of deliberate faults fits the code: ``tests/mutation/run.py`` runs it."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

import dsom_jax

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "mutation"))

from faults import FAULTS  # noqa: E402

ROOT = Path(dsom_jax.__file__).parent


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: f"{fault.file}:{fault.old[:30]}")
def test_a_fault_is_one_change_of_valid_code_that_named_tests_look_at(fault):
    source = (ROOT / fault.file).read_text()
    assert source.count(fault.old) == 1
    changed = source.replace(fault.old, fault.new)
    assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(source))
    names = [
        line for test in fault.tests.split() for line in (HERE / test).read_text().splitlines() if "def test_" in line
    ]
    assert names and any(word in line for line in names for word in (fault.only or "test").split(" or "))


def test_there_are_enough():
    assert len(FAULTS) >= 60 and len(set(FAULTS)) == len(FAULTS)
