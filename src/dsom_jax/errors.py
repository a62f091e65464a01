"""One clear line for bad input, and exit code 2."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import NoReturn


class UserError(Exception):
    """Bad input; the message names the file, the field and the fix in one line."""


def run_cli(main: Callable[[], None]) -> None:
    """Run ``main``; a :class:`UserError`, and too much asked of the memory, become one line on stderr, exit code 2."""
    try:
        main()
    except UserError as error:
        refuse(str(error))
    except (MemoryError, RuntimeError) as error:  # XLA's error is a RuntimeError
        if not isinstance(error, MemoryError) and "out of memory" not in str(error).lower():
            raise
        refuse(f"out of memory ({str(error)[:160]}); use a coarser map, or fewer particles, runs or scans")


def refuse(message: str) -> NoReturn:
    """Say in one line what is wrong, and end."""
    print("error: " + " ".join(message.split()), file=sys.stderr)
    raise SystemExit(2) from None
