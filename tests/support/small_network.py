"""A network of a user's own, as text of a definitions file."""

SMALL = """
import jax.numpy as jnp
from mjx_tt.env.user_network import network

@network("small", shapes={"w1": (11, 16), "b1": (16,), "w2": (16, 8)})
class Small:
    @staticmethod
    def start(p, x):
        return x

    @staticmethod
    def step(p, last, x):
        return jnp.tanh(jnp.tanh((x + 0.5 * last) @ p["w1"] + p["b1"]) @ p["w2"]), x
"""
