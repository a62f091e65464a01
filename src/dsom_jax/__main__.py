"""The command lines by name: ``python -m dsom_jax bench ...``; of an installed package also ``dsom-bench ...``."""

from __future__ import annotations

import sys
from functools import partial
from importlib import import_module

from dsom_jax.errors import UserError, run_cli

COMMANDS = ("demo", "inspect", "localize", "ros2", "certify", "bench", "export", "evaluate", "train", "train_filter")
_PACKAGES = ("ros2",)
"""Commands that are folders."""


def _start(name: str) -> None:
    """Run the command ``name`` with the words of the command line; what it needs is imported here."""
    module = f"dsom_jax.{name}.__main__" if name in _PACKAGES else f"dsom_jax.{name}"
    run_cli(lambda: import_module(module).main())


demo, inspect, localize, ros2, certify, bench, export, evaluate, train, train_filter = (
    partial(_start, name) for name in COMMANDS
)


def main() -> None:
    """The first word of the command line is a command."""
    names = ", ".join(COMMANDS)
    if len(sys.argv) < 2 or sys.argv[1] in ("-h", "--help"):
        print(f"usage: python -m dsom_jax COMMAND ...; commands: {names}")
        return
    name = sys.argv.pop(1)
    if name.replace("-", "_") not in COMMANDS:
        raise UserError(f"{name}: no such command; there are {names}")
    _start(name.replace("-", "_"))


if __name__ == "__main__":
    run_cli(main)
