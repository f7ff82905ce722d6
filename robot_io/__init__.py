"""The robot's side: the contract with the policy, exported policies, the safety gate and the control process.

Names load when they are first used; nothing here needs JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
