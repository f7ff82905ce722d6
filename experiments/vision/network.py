"""The ball in a window of three frames: whether, where, how sure, how fast. A convolutional network with cells of 4 px.

Every fine cell gives six numbers: how likely the ball's centre is in it (a softmax over all cells and "no ball"), its
offset from the cell's middle [cells], and the offset's uncertainty as a factor of its inverse covariance (log a, b,
log c: white errors are a du and c dv + b du). Every coarse cell of 8 px gives four: how likely the ball was in
it one frame ago, its offset, and the log of that one's precision. The velocity is the way between the two; one that is
regressed is learnt late, and never beyond the window.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from robot_io.vision.detector import AROUND, CELL, FAR_CELL, FAR_OUTPUTS, OUTPUTS

WIDTH = 24  # channels
COARSE_WIDTH = 16
BLOCKS = (1, 2, 4, 1)  # dilations of the fine part
COARSE_BLOCKS = (1, 2, 4)  # dilations of the coarse one
DARK = 0.003  # under the root, which makes noise alike in dark and bright


def pack(frames: Array) -> Array:
    """Quads of pixels as channels: (n, h, w, t) in 0..255 to (n, h/2, w/2, 4 t) in 0..1."""
    n, h, w, t = frames.shape
    quads = frames.reshape(n, h // 2, 2, w // 2, 2, t).transpose(0, 1, 3, 2, 4, 5)
    return quads.reshape(n, h // 2, w // 2, 4 * t).astype(jnp.float32) / 255.0


class BallNetwork(nn.Module):
    """The fine part sees the window in full, the coarse one twice as far around at half resolution."""

    @nn.compact
    def __call__(self, fine: Array, coarse: Array) -> tuple[Array, Array]:
        """Packed crops (n, 32, 32, 12) to what every fine (n, 16, 16, 6) and coarse cell (n, 16, 16, 4) says."""
        far = nn.relu(nn.Conv(COARSE_WIDTH, (3, 3), strides=2, name="coarse")(jnp.sqrt(coarse + DARK)))
        for k, dilation in enumerate(COARSE_BLOCKS):
            far = far + nn.relu(nn.Conv(COARSE_WIDTH, (3, 3), kernel_dilation=dilation, name=f"coarse{k}")(far))
        past = nn.relu(nn.Conv(WIDTH, (3, 3), name="past")(far))
        past = nn.Conv(FAR_OUTPUTS, (1, 1), name="past_out")(past)
        side = far.shape[1] // 4
        far = far[:, side:-side, side:-side].repeat(2, 1).repeat(2, 2)
        x = nn.relu(nn.Conv(WIDTH, (3, 3), strides=2, name="fine")(jnp.sqrt(fine + DARK)))
        for k, dilation in enumerate(BLOCKS):
            if k == 1:
                x = x + nn.Conv(WIDTH, (1, 1), name="join")(far)
            y = nn.relu(nn.Conv(WIDTH, (3, 3), kernel_dilation=dilation, name=f"block{k}")(x))
            x = x + nn.Conv(WIDTH, (1, 1), name=f"mix{k}")(y)
        x = nn.relu(nn.Conv(2 * WIDTH, (3, 3), name="last")(x))
        return nn.Conv(OUTPUTS, (1, 1), name="out")(x), past


def _locate(out: Array, spot: Array, present: Array) -> tuple[Array, Array, Array]:
    """Of outputs (n, h, w, c) and balls at ``spot`` (n, 2) [cells] where ``present`` (n,) is 1: the cost (n,) of which
    cell, weights (n, h, w) of the cells near the ball, and their true offsets (n, h, w, 2)."""
    n, h, w, _ = out.shape
    ys, xs = jnp.mgrid[:h, :w] + 0.5
    away = jnp.stack([spot[:, :1, None] - xs, spot[:, 1:, None] - ys], -1)
    squared = (away**2).sum(-1)
    near = jnp.where(squared < 2.25, jnp.exp(-squared / 0.5), 0.0).reshape(n, -1)
    near = near / (near.sum(1, keepdims=True) + 1e-9) * present[:, None]
    logits = jnp.concatenate([out[..., 0].reshape(n, -1), jnp.zeros((n, 1))], 1)
    which = -(jnp.concatenate([near, 1 - present[:, None]], 1) * jax.nn.log_softmax(logits)).sum(1)
    return which, near.reshape(n, h, w), away


def loss(out: tuple[Array, Array], labels: Array) -> Array:
    """Mean cost of what the network says of n crops with these labels (n, 6) (see ``crops.Crops``)."""
    cells, past = out
    present, spot = labels[:, 0], labels[:, 1:3] + 0.5
    which, weight, away = _locate(cells, spot / CELL, present)
    offset = away - cells[..., 1:3]
    log_a, b, log_c = jnp.clip(cells[..., 3], -2, 5), cells[..., 4], jnp.clip(cells[..., 5], -2, 5)
    white = jnp.stack([jnp.exp(log_a) * offset[..., 0], jnp.exp(log_c) * offset[..., 1] + b * offset[..., 0]], -1)
    place = 0.5 * (white**2).sum(-1) - log_a - log_c + 4 * jnp.minimum(jnp.abs(offset), 3).sum(-1)

    before = (spot - labels[:, 3:5] + AROUND) / FAR_CELL
    was = present * ((before > 0) & (before < past.shape[1])).all(1)
    which_past, weight_past, away_past = _locate(past, before, was)
    offset = away_past - past[..., 1:3]
    log_p = jnp.clip(past[..., 3], -2, 5)
    squared = (offset**2).sum(-1) * jnp.exp(2 * log_p)
    # A bounce or stroke between the frames makes the label wrong: far misses count by their logarithm.
    place_past = 3 * jnp.log1p(squared / 4) - 2 * log_p + 4 * jnp.minimum(jnp.abs(offset), 3).sum(-1)
    sums = 0.25 * (weight * place).sum() + 0.15 * (weight_past * place_past).sum()
    return which.mean() + 0.5 * which_past.mean() + sums / labels.shape[0]


def start(key: Any) -> Any:
    """Untrained parameters."""
    packed = jnp.zeros((1, 32, 32, 12))
    return BallNetwork().init(key, packed, packed)["params"]


@jax.jit
def apply(params: Any, fine: Array, coarse: Array) -> tuple[Array, Array]:
    """What it says of crops (n, 64, 64, 3) in 0..255: of fine (n, 16, 16, 6) and of coarse cells (n, 16, 16, 4)."""
    said: Any = BallNetwork().apply({"params": params}, pack(fine), pack(coarse))
    return said
