"""What XLA is told beyond its defaults, in one place."""

from __future__ import annotations

from functools import cache

import jax

_LIBRARY = {"xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_DOT"}
"""YNNPACK for matrix products only. Its reductions sum in an order that depends on how many rows there are, so that run
r of 100 would differ from run r alone in the last bits; its convolutions use one thread, where XLA's own use all."""
_REDUCTIONS = {"xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_REDUCE"}
"""YNNPACK for reductions only: in training its products, too, are slower than XLA's own on all threads."""
_QUICK = {"xla_backend_optimization_level": "1"}
"""LLVM's first level compiles a quarter faster than its third, and what it makes of a filter is as fast."""


def run_options() -> dict[str, str]:
    """Compiler options of filters and proposals: repeatable whatever the number of runs, and quick to compile."""
    return _known({**_LIBRARY, **_QUICK})


def training_options() -> dict[str, str]:
    """Compiler options of a network's training and evaluation."""
    return _known(_REDUCTIONS)


def _known(options: dict[str, str]) -> dict[str, str]:
    """The options on CPUs whose XLA knows them all, none elsewhere."""
    return dict(options) if jax.default_backend() == "cpu" and _accepted(tuple(options.items())) else {}


@cache
def _accepted(options: tuple[tuple[str, str], ...]) -> bool:
    try:
        jax.jit(lambda x: x, compiler_options=dict(options))(0.0)
    except jax.errors.JaxRuntimeError:  # an XLA without an experimental switch
        return False
    return True
