"""Measured balls from files, and files written whole: CSV, MCAP, the DeepMind ball states, the AIMY launcher, YAML.

The readers load when they are first used, so that a program at the robot can write files with NumPy alone.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
