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


def test_every_script_is_a_command():
    scripts = PROJECT["project"]["scripts"]
    for script, target in scripts.items():
        module, name = target.split(":")
        start = getattr(import_module(module), name)
        assert script == "dsom-" + name.replace("_", "-") and start.args == (name,)
    names = {script.removeprefix("dsom-").replace("-", "_") for script in scripts}
    assert set(commands.COMMANDS) - {"inspect", "ros2"} <= names <= set(commands.COMMANDS)


def test_what_can_be_started_is_a_command():
    """Every module, and every folder by its ``__main__``, that runs as a program."""
    package = Path(commands.__file__).parent
    guarded = {path for path in package.rglob("*.py") if '__name__ == "__main__"' in path.read_text()}
    names = {path.parent.name if path.stem == "__main__" else path.stem for path in guarded - {Path(commands.__file__)}}
    assert names == set(commands.COMMANDS)
    assert all(getattr(commands, name).args == (name,) for name in names)


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("train-filter", "Train PF-Net or PFRNN"),
        ("inspect", "what is in a log and a map"),
        ("ros2", "Localize one robot"),
    ],
)
def test_a_command_is_the_first_word(monkeypatch, capsys, word, says):
    monkeypatch.setattr(sys, "argv", ["dsom_jax", word, "--help"])
    with pytest.raises(SystemExit) as stop:
        commands.main()
    assert not stop.value.code and says in capsys.readouterr().out


def test_words_that_are_no_command(monkeypatch, capsys):
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
