"""What is kept for later processes of the same user: what JAX compiled."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path

import jax


def keep_compiled() -> None:
    """Let JAX keep what it compiles in the user's cache folder, unless the environment names another or forbids it."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    folder = cache_folder() / "jax"
    with suppress(OSError):  # without a place to write to, everything works, and is compiled every time
        folder.mkdir(parents=True, exist_ok=True)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def cache_folder() -> Path:
    """Where programs of this user keep what they can make again."""
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "dsom_jax"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dsom_jax"
