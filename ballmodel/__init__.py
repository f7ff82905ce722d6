"""Ball flight, impacts, fits of measured balls, and the distributions of the balls that people play.

Names load when they are first used: ``ballmodel.constants`` and ``ballmodel.io`` need no JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
