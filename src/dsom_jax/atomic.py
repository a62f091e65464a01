"""Writing whole files: what is read later is the old content or the new, never a part of either."""

from __future__ import annotations

import os
from pathlib import Path

from dsom_jax.errors import UserError


def write_atomic(path: str | Path, content: bytes) -> None:
    """Write a file beside ``path`` and rename it; folders are made where needed. UserError where that cannot be."""
    path = Path(path)
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            _write(draft, content)
            draft.replace(path)
        finally:
            draft.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror}); choose another output folder") from None


def _write(path: Path, content: bytes) -> None:
    """Write and see to it that a power cut after the renaming leaves no empty file."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
