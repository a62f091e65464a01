"""Where might the robot be, by this scan or by all so far? Samplable observation models.

``__init__.pyi`` lists the public names; each is imported at its first use. ``filters.make_proposal`` makes one by its
name: ``likelihood_grid``, ``dsom``, ``hybrid``, ``markov_grid``, ``dual_features``, ``uniform``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
