"""Public names of the proposals; ``__init__.py`` imports each from here at its first use."""

from .dsom import DSOMProposal
from .dual_features import DualFeatures, DualFeaturesConfig, with_episode
from .hybrid import Hybrid, HybridConfig
from .likelihood_grid import LikelihoodGrid, LikelihoodGridConfig
from .markov_grid import MarkovGrid, MarkovGridConfig
from .markov_network import MarkovNetwork, MarkovNetworkConfig
from .uniform import FreeSpace, free_space

__all__ = [
    "DSOMProposal",
    "DualFeatures",
    "DualFeaturesConfig",
    "FreeSpace",
    "Hybrid",
    "HybridConfig",
    "LikelihoodGrid",
    "LikelihoodGridConfig",
    "MarkovGrid",
    "MarkovGridConfig",
    "MarkovNetwork",
    "MarkovNetworkConfig",
    "free_space",
    "with_episode",
]
