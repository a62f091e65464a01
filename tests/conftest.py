"""What all tests share: how they compile, and which examples hypothesis draws.

Nearly all of the time goes into compiling. What is compiled is kept for the other workers and for the processes that
tests start, in a folder of this run alone: no test meets anything that an older run has left.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# All of this before JAX is imported; workers and processes that tests start inherit it.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
OWN_CACHE = None if "JAX_COMPILATION_CACHE_DIR" in os.environ else tempfile.mkdtemp(prefix="dsom-tests-")
if OWN_CACHE:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = OWN_CACHE

settings.register_profile(
    "stable",
    derandomize=True,
    max_examples=25,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.load_profile("stable")


def pytest_unconfigure() -> None:
    """The process that made the folder removes it; workers found it in their environment."""
    if OWN_CACHE:
        shutil.rmtree(OWN_CACHE, ignore_errors=True)


MAPPINGS = Path("/proc/self/maps")
MANY = 20_000
"""Linux ends a process with 65,530 mappings, and what one file of tests compiles takes up to 8,000."""


@pytest.fixture(scope="module", autouse=True)
def _few_mappings():
    """A worker forgets what it has compiled before the mappings of its memory run out."""
    yield
    if MAPPINGS.exists() and MAPPINGS.read_bytes().count(b"\n") > MANY:
        import jax

        jax.clear_caches()


@pytest.fixture(scope="session", autouse=True)
def _small_blocks():
    """Grids of free cells are filled up to 512 in place of 4096: the rooms of most tests have about 300.

    The tests of the likelihood grid itself take the true number.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dsom_jax.proposals.likelihood_grid._BLOCK", 512)
        yield
