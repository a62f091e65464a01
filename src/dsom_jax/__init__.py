"""Find a lidar robot on a known map: DSOM and AdaM MCL in JAX.

What one needs first is here under its own name (``dsom_jax.run``, ``dsom_jax.load_map``, ...), the rest in name spaces:
``filters``, ``proposals``, ``sensor``, ``motion``, ``maps``, ``logs``, ``judging``, ``simulate``, ``nn``, ``plotting``.
``__init__.pyi`` lists the names; each is imported at its first use, so that ``import dsom_jax`` costs nothing.
"""

import os
import sys

import lazy_loader

if sys.argv[:1] == ["-m"]:  # a command line of this package, before JAX is there
    # XLA's alarms (slow folding of constants, features of other processors) say nothing to who looks for a robot.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
