"""The ball in a window of three frames: whether, where, how sure, how fast. A convolutional network with cells of 4 px.

Every cell gives nine numbers: how likely the ball's centre is in it (a softmax over all cells and "no ball"), its offset
from the cell's middle [cells], the offset's uncertainty as a factor of its inverse covariance (log a, b, log c: white
errors are ``a du`` and ``c dv + b du``), the velocity [10 px a frame] and its log deviation.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from robot_io.vision.detector import CELL, OUTPUTS, SPEED_UNIT

WIDTH = 24  # channels
COARSE_WIDTH = 16
BLOCKS = (1, 2, 4, 1)  # dilations of the fine part
COARSE_BLOCKS = (1, 2, 4)  # dilations of the coarse one
DARK = 0.003  # under the root, which makes noise alike in dark and bright


def pack(frames: Float[Array, "n h w t"]) -> Float[Array, "n g v c"]:
    """Quads of pixels as channels: (n, h, w, t) in 0..255 to (n, h/2, w/2, 4 t) in 0..1."""
    n, h, w, t = frames.shape
    quads = frames.reshape(n, h // 2, 2, w // 2, 2, t).transpose(0, 1, 3, 2, 4, 5)
    return quads.reshape(n, h // 2, w // 2, 4 * t).astype(jnp.float32) / 255.0


class BallNetwork(nn.Module):
    """The fine part sees the window in full, the coarse one twice as far around at half resolution."""

    @nn.compact
    def __call__(
        self, fine: Float[Array, "n 32 32 12"], coarse: Float[Array, "n 32 32 12"]
    ) -> Float[Array, "n 16 16 9"]:
        """Packed crops to what every cell says."""
        far = nn.relu(nn.Conv(COARSE_WIDTH, (3, 3), strides=2, name="coarse")(jnp.sqrt(coarse + DARK)))
        for k, dilation in enumerate(COARSE_BLOCKS):
            far = far + nn.relu(nn.Conv(COARSE_WIDTH, (3, 3), kernel_dilation=dilation, name=f"coarse{k}")(far))
        side = far.shape[1] // 4
        far = far[:, side:-side, side:-side].repeat(2, 1).repeat(2, 2)
        x = nn.relu(nn.Conv(WIDTH, (3, 3), strides=2, name="fine")(jnp.sqrt(fine + DARK)))
        for k, dilation in enumerate(BLOCKS):
            if k == 1:
                x = x + nn.Conv(WIDTH, (1, 1), name="join")(far)
            y = nn.relu(nn.Conv(WIDTH, (3, 3), kernel_dilation=dilation, name=f"block{k}")(x))
            x = x + nn.Conv(WIDTH, (1, 1), name=f"mix{k}")(y)
        x = nn.relu(nn.Conv(2 * WIDTH, (3, 3), name="last")(x))
        return nn.Conv(OUTPUTS, (1, 1), name="out")(x)


def loss(out: Float[Array, "n h w 9"], labels: Float[Array, "n 6"]) -> Float[Array, ""]:
    """Mean cost of what the network says of crops with these labels (see ``crops.Crops``)."""
    n, h, w, _ = out.shape
    present, spot = labels[:, 0], (labels[:, 1:3] + 0.5) / CELL
    speed = (labels[:, 3:5] / SPEED_UNIT)[:, None, None]
    ys, xs = jnp.mgrid[:h, :w] + 0.5
    away = jnp.stack([spot[:, :1, None] - xs, spot[:, 1:, None] - ys], -1)
    squared = (away**2).sum(-1)
    near = jnp.where(squared < 2.25, jnp.exp(-squared / 0.5), 0.0).reshape(n, -1)
    near = near / (near.sum(1, keepdims=True) + 1e-9) * present[:, None]
    logits = jnp.concatenate([out[..., 0].reshape(n, -1), jnp.zeros((n, 1))], 1)
    where = -(jnp.concatenate([near, 1 - present[:, None]], 1) * jax.nn.log_softmax(logits)).sum(1)

    weight = near.reshape(n, h, w)
    offset = away - out[..., 1:3]
    log_a, b, log_c = jnp.clip(out[..., 3], -2, 5), out[..., 4], jnp.clip(out[..., 5], -2, 5)
    white = jnp.stack([jnp.exp(log_a) * offset[..., 0], jnp.exp(log_c) * offset[..., 1] + b * offset[..., 0]], -1)
    place = 0.5 * (white**2).sum(-1) - log_a - log_c + 4 * jnp.minimum(jnp.abs(offset), 3).sum(-1)
    # The deviation must not excuse a wrong velocity, so its likelihood gives the mean no gradient.
    log_v = jnp.clip(out[..., 8], -4, 3)
    wrong = optax.huber_loss(out[..., 6:8], jnp.broadcast_to(speed, out[..., 6:8].shape), delta=0.5).sum(-1)
    missed = jax.lax.stop_gradient(((out[..., 6:8] - speed) ** 2).sum(-1))
    moving = 0.5 * wrong + 0.1 * (0.5 * missed * jnp.exp(-2 * log_v) + 2 * log_v)
    return where.mean() + (weight * (0.25 * place + moving)).sum() / n


def start(key: Any) -> Any:
    """Untrained parameters."""
    packed = jnp.zeros((1, 32, 32, 12))
    return BallNetwork().init(key, packed, packed)["params"]


@jax.jit
def apply(params: Any, fine: Array, coarse: Array) -> Array:
    """What the network says (n, 16, 16, 9) of crops (n, 64, 64, 3) in 0..255."""
    return BallNetwork().apply({"params": params}, pack(fine), pack(coarse))
