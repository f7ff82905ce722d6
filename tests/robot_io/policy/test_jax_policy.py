from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from robot_io.policy import jax_policy

FRAMES = "jax_traceback_in_locations_limit"


@jax.jit
def _gain(x):
    return jnp.tanh(2.0 * x)


def _twice(x):
    return _gain(_gain(x))


def test_a_serialised_function_names_no_source_file():
    """JAX itself writes the path of this file into it: the check below can fail."""
    place, shape = __file__.encode(), jax.ShapeDtypeStruct((3,), jnp.float32)
    before = getattr(jax.config, FRAMES)
    plain = bytes(jax.export.export(jax.jit(_twice), platforms=["cpu"])(shape).serialize())
    content = jax_policy.serialised(_twice, shape)
    assert place in plain and place not in content and b".py" not in content
    assert getattr(jax.config, FRAMES) == before
    x = np.array([-1.0, 0.1, 3.0], np.float32)
    np.testing.assert_allclose(
        jax.export.deserialize(bytearray(content)).call(x), np.tanh(2.0 * np.tanh(2.0 * x)), rtol=1e-6
    )
