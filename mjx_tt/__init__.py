"""Simulated robot table tennis in JAX: environments, rollouts, rallies, and the diagnosis of a simulation from logs.

Names load when they are first used; call ``configure`` before anything else starts JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
