"""One clear line for bad input, and exit code 2."""

from __future__ import annotations

import reprlib
import sys
from collections.abc import Callable
from typing import Any, NoReturn

LONGEST = 400
"""Characters of a message; what is longer loses its middle: the file stands first, the fix last."""


class UserError(Exception):
    """Bad input; the message names the file, the field and the fix in one line that any terminal can take."""

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


def one_line(text: str, most: int = LONGEST) -> str:
    """``text`` without line breaks, with control characters as escapes, cut in its middle to ``most`` characters."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in " ".join(text.split()))
    return line if len(line) <= most else f"{line[: most * 5 // 8]} ... {line[len(line) - most * 3 // 8 + 5 :]}"


def shown(value: Any) -> str:
    """A value out of somebody's file for a message: never longer than a line, whatever it holds."""
    brief = reprlib.Repr()
    brief.maxlevel, brief.maxstring, brief.maxother, brief.maxlist, brief.maxtuple, brief.maxdict = 2, 60, 60, 6, 6, 3
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 128:
        return f"an integer of some {round(value.bit_length() * 0.30103)} digits"
    try:
        return one_line(brief.repr(value), 120)
    except ValueError:  # Python prints no integers of thousands of digits
        return f"a {type(value).__name__}"


def run_cli(main: Callable[[], None]) -> None:
    """Run ``main``; a :class:`UserError`, and too much asked of the memory, become one line on stderr, exit code 2.

    Ctrl-C ends with one line and exit code 130; a reader of the output that goes away (``| head``) ends it in silence.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # a terminal that knows ASCII only, or a name that is no text
    try:
        main()
    except UserError as error:
        refuse(str(error))
    except KeyboardInterrupt:
        print("interrupted; files that were written before are complete", file=sys.stderr)
        raise SystemExit(130) from None
    except BrokenPipeError:
        sys.stdout = None  # or Python would complain once more when it flushes at the end
        raise SystemExit(141) from None  # as the shell reports a program that SIGPIPE ends
    except (MemoryError, RuntimeError) as error:  # XLA's error is a RuntimeError
        if not isinstance(error, MemoryError) and "out of memory" not in str(error).lower():
            raise
        refuse(f"out of memory ({str(error)[:160]}); use a coarser map, or fewer particles, runs or scans")


def refuse(message: str) -> NoReturn:
    """Say in one line what is wrong, and end."""
    print("error: " + one_line(message), file=sys.stderr)
    raise SystemExit(2) from None
