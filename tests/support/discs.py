"""Discs that move, as a Bayer camera sees them; drawn without the project's renderer."""

from __future__ import annotations

import numpy as np


def draw_discs(middles, size=(512, 640), colour=(220.0, 110.0, 25.0), radius=7.0):
    """Frames of a shaded disc over a slope of grey, as a Bayer camera sees them."""
    rng, (ys, xs) = np.random.default_rng(0), np.mgrid[: size[0], : size[1]].astype(float)
    channel = np.array([[0, 1], [1, 2]])[(ys.astype(int) % 2), (xs.astype(int) % 2)]
    frames = []
    for u, v in middles:
        cover = np.clip(radius - np.hypot(xs - u, ys - v) + 0.5, 0, 1)
        shade = 0.85 - 0.3 * (ys - v) / radius
        level = (30 + 40 * xs / size[1]) * (1 - cover) + cover * shade * np.array(colour)[channel]
        frames.append(np.clip(level + rng.normal(0, 2, size), 0, 255).astype(np.uint8))
    return frames
