"""``Policy`` as a JAX pytree. Imported by whatever hands policies to JAX; needs JAX."""

from __future__ import annotations

import jax

from robot_io.policy.policy import Policy as Policy

jax.tree_util.register_dataclass(Policy, data_fields=["theta", "mean", "inv_std"], meta_fields=["network"])
