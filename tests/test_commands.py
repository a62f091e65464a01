"""The commands of the package: their names, and what is in the wheel."""

from __future__ import annotations

import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

from dsom_jax import __main__ as commands
from dsom_jax import bench, checkpoint
from dsom_jax.errors import UserError

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_script_is_a_command_and_every_command_has_a_script():
    scripts = PROJECT["project"]["scripts"]
    for script, target in scripts.items():
        module, name = target.split(":")
        start = getattr(import_module(module), name)
        assert script == "dsom-" + name.replace("_", "-") and start.args == (name,)
        assert callable(import_module(f"dsom_jax.{name}").main)
    assert {script.removeprefix("dsom-").replace("-", "_") for script in scripts} == set(commands.COMMANDS)


def test_a_command_is_the_first_word(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["dsom_jax", "train-filter", "--help"])
    with pytest.raises(SystemExit) as stop:
        commands.main()
    assert not stop.value.code and "Train PF-Net or PFRNN" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["dsom_jax", "fly"])
    with pytest.raises(UserError, match="fly: no such command; there are demo"):
        commands.main()
    monkeypatch.setattr(sys, "argv", ["dsom_jax"])
    commands.main()
    assert "localize" in capsys.readouterr().out


def test_the_wheel_holds_the_networks_that_commands_take_by_default():
    given = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    shipped = {checkpoint.shipped(kind).relative_to(ROOT).as_posix() for kind in ("dsom", "pf_net", "pfrnn")}
    assert set(given) == shipped
    for source, target in given.items():
        # Where checkpoint.py looks once it is installed.
        assert target == f"dsom_jax/{source}"


def test_methods_that_are_left_out_are_named_with_the_reason():
    assert bench.left_out(bench.STANDARD) == ""
    line = bench.left_out(bench.chosen_methods("", None))
    assert line.startswith("left out: mixture_mcl_dsom, adam_dsom") and "--checkpoint" in line
