"""Every script of ``experiments`` can be imported: a function that was renamed cannot break one unseen."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "experiments"
SCRIPTS = sorted(FOLDER.glob("*/*.py"))


def of_a_script(module: ModuleType) -> bool:
    """Whether a module lies in ``experiments``, whose folders have scripts of the same name."""
    return Path(getattr(module, "__file__", None) or "/").is_relative_to(FOLDER)


@pytest.fixture
def only_here(monkeypatch):
    """Puts the search path and the modules back: scripts import their neighbours by short names such as ``timing``."""
    before = {name: module for name, module in sys.modules.items() if of_a_script(module)}
    for name in before:
        del sys.modules[name]
    yield monkeypatch
    for name in [name for name, module in sys.modules.items() if of_a_script(module)]:
        del sys.modules[name]
    sys.modules.update(before)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_scripts_can_be_imported(path, only_here):
    only_here.syspath_prepend(path.parent)
    spec = importlib.util.spec_from_file_location(f"experiment_{path.parent.name}_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    only_here.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    assert module.__doc__


def test_there_are_scripts():
    assert len(SCRIPTS) >= 12
