"""One robot, live."""

from dsom_jax.live.answer import NOWHERE, Answer, Hypothesis
from dsom_jax.live.localizer import Localizer

__all__ = ["NOWHERE", "Answer", "Hypothesis", "Localizer"]
