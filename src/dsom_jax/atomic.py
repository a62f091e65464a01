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
            sync(path.parent)
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


def sync(path: Path) -> None:
    """Have a file, or the names in a folder, reach the disk; folders of some systems cannot be asked to."""
    if path.is_dir() and os.name == "nt":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_tree(folder: Path) -> None:
    """Have a folder with all that is in it reach the disk, and its own name last."""
    for root, _, files in os.walk(folder, topdown=False):
        for name in files:
            sync(Path(root) / name)
        sync(Path(root))
    sync(folder.parent)
