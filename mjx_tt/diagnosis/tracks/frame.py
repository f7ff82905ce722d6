"""Frame of measured balls: units, axes and origin, from how they fall, where they bounce and where they travel.

All figures are medians over a log's pieces, so that wild samples, hits and swapped ids do not move them. Drag is taken
off before a fall is judged: from 8.5 m/s on it exceeds gravity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ballmodel.constants import BALL_RADIUS, NET_HEIGHT, TABLE_HEIGHT, TABLE_LENGTH, TABLE_WIDTH
from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.tracks.chains import Track, take_apart

GRAVITY_RANGE = (5.0, 15.0)  # [m/s^2] that a fall in metres and seconds may show
BOUNCE_RANGE = (-0.05, 0.12)  # [m] height of the ball's centre at a bounce in the table frame
FEWEST = 8  # samples of a trajectory that tells anything
SPAN = 0.06  # [s] between the three samples that give an acceleration
DRAG = 0.12  # [1/m] of a ball, low rather than high
MARGIN = 0.08  # [m] beside the table within which a bounce is one on it
LEVEL = 0.10  # [m] of height within which a bounce is at the table's, or the floor's
LOW = NET_HEIGHT - 0.03  # [m] below which no ball passes the net's place
WRONG = 0.25  # share of bounces and passages over the net that do not fit, from which the frame is another
EXPLAINED = 0.4  # of that share, left by a named offset that explains it
MOST = 200  # trajectories looked at, spread over the log


@dataclass(frozen=True)
class _Signs:
    """Bounces and paths of a log in its own frame."""

    bounces: Float[np.ndarray, "3 b"]  # [m]
    paths: tuple[Float[np.ndarray, "3 k"], ...]  # [m] of the arcs

    def misfit(self, shift: Sequence[float]) -> tuple[int, int, int]:
        """Bounces, and passages over the net's place, that cannot be after a shift [m]; and how many there are."""
        by = np.asarray(shift)[:, None]
        x, y, z = self.bounces + by
        over_table = (np.abs(x) < TABLE_WIDTH / 2 + MARGIN) & (np.abs(y) < TABLE_LENGTH / 2 + MARGIN)
        inside = (np.abs(x) < TABLE_WIDTH / 2 - MARGIN) & (np.abs(y) < TABLE_LENGTH / 2 - MARGIN)
        on_table = over_table & (np.abs(z - BALL_RADIUS) < LEVEL)
        played = on_table.sum() >= 0.3 * x.size  # without bounces on the table there is no floor beside it
        on_floor = played & ~inside & (np.abs(z - BALL_RADIUS + TABLE_HEIGHT) < LEVEL)
        low = count = 0
        for path in self.paths:
            p = path + by
            k = np.flatnonzero(p[1, :-1] * p[1, 1:] < 0.0)
            here = k[np.abs(p[0, k]) < TABLE_WIDTH / 2]
            count += here.size
            low += int(np.sum(np.maximum(p[2, here], p[2, here + 1]) < LOW))
        return int(np.sum(~(on_table | on_floor))), low, count + x.size


def _offsets() -> dict[str, tuple[float, float, float]]:
    """Likely origins, and what has to be added to coordinates that count from them."""
    half_x, half_y = TABLE_WIDTH / 2, TABLE_LENGTH / 2
    corner = "the corner of the table at"
    places = {
        "the table's centre": (0.0, 0.0),
        f"{corner} the least x and y": (-half_x, -half_y),
        f"{corner} the largest x and y": (half_x, half_y),
        f"{corner} the largest x and the least y": (half_x, -half_y),
        f"{corner} the least x and the largest y": (-half_x, half_y),
    }
    places |= {"the middle of an end line": (0.0, -half_y), "the middle of the other end line": (0.0, half_y)}
    places |= {"the middle of a side line": (-half_x, 0.0), "the middle of the other side line": (half_x, 0.0)}
    out = {}
    for name, (x, y) in places.items():
        out[name] = (x, y, 0.0)
        out[f"{name}, and z from the floor"] = (x, y, -TABLE_HEIGHT)
    return out


def check(trajectories: Sequence[Trajectory], source: str) -> None:
    """Refuses balls that cannot be metres and seconds in the table frame.

    Raises ValueError that describes what they look like, with the offset that would mend it where one is likely.
    """
    if not trajectories:
        raise ValueError(f"{source}: holds no trajectory")
    long = [t for t in trajectories if len(t) >= FEWEST]
    if not long:
        raise ValueError(f"{source}: no trajectory has {FEWEST} samples, the longest has {max(map(len, trajectories))}")
    long = long[:: -(-len(long) // MOST)]
    bend, fall = (np.median(a, axis=0) for a in zip(*map(_acceleration, long), strict=True))
    largest = float(np.abs(bend).max())
    if largest > 100.0 * GRAVITY_RANGE[1]:
        raise ValueError(
            f"{source}: balls fall at {largest:.0f} per s^2, metres and seconds are wanted (are these millimetres?)"
        )
    signs = _signs([take_apart(t) for t in long])
    wrong, low, count = signs.misfit((0.0, 0.0, 0.0))
    bounces = signs.bounces.shape[1]
    many = bounces >= max(3, 0.2 * len(long))
    proven = many and wrong < 0.1 * bounces
    if not proven:
        _check_fall(bend, fall, source)
    travel = np.median([np.ptp(np.percentile(t.position, [5, 95], axis=1), axis=0) for t in long], axis=0)
    if travel[0] > 2.0 * travel[1]:
        raise ValueError(
            f"{source}: balls travel {travel[0]:.2f} m along x and {travel[1]:.2f} m along y; y is the table's length "
            "(swapped axes?)"
        )
    if many:
        _check_origin(signs, wrong, low, count, source)
    middle = np.median(np.concatenate([t.position for t in long], axis=1), axis=1)
    if abs(middle[0]) > 1.5 or abs(middle[1]) > 2.5:
        raise ValueError(
            f"{source}: the balls' middle is x = {middle[0]:.2f}, y = {middle[1]:.2f} m, far from the table's centre "
            "(another frame?)"
        )


def _check_fall(bend: Float[np.ndarray, "3"], fall: Float[np.ndarray, "3"], source: str) -> None:
    """Raises ValueError unless balls fall along -z, their drag taken off."""
    down = int(np.argmax(np.abs(fall)))
    if not GRAVITY_RANGE[0] < np.abs(fall[down]) < GRAVITY_RANGE[1]:
        raise ValueError(
            f"{source}: balls accelerate by ({', '.join(f'{a:.3g}' for a in bend)}) in x, y, z; a fall of 9.8 m/s^2 "
            "along -z is wanted (wrong unit of length or time, or no free flights?)"
        )
    if down != 2:
        raise ValueError(f"{source}: balls fall along {'xyz'[down]}, z must point up (swapped axes?)")
    if fall[2] > 0.0:
        raise ValueError(f"{source}: balls fall towards +z, z must point up")


def _check_origin(signs: _Signs, wrong: int, low: int, count: int, source: str) -> None:
    """Raises ValueError where bounces and passages over the net are not where table and net are."""
    bounces = signs.bounces.shape[1]
    median = np.median(signs.bounces, axis=1)
    misfit = (wrong + low) / count
    x, y, z = signs.bounces
    quarter = np.mean((x > -MARGIN) & (y > -MARGIN)) > 0.95
    if wrong < WRONG * bounces and not (quarter and misfit > WRONG):
        return
    found = {name: signs.misfit(shift) for name, shift in _offsets().items()}
    name = min(found, key=lambda n: (found[n][0] + found[n][1]) / max(found[n][2], 1))
    left = (found[name][0] + found[name][1]) / max(found[name][2], 1)
    hint = "another frame: is z measured from the floor, or from the camera?"
    if left < EXPLAINED * misfit:
        shift = _offsets()[name]
        hint = f"is the origin {name}? Then add ({', '.join(f'{s:+.4g}' for s in shift)}) m to x, y, z"
        if name.startswith("the table's centre, "):
            hint = f"another frame: is z measured from the floor? Then add {shift[2]:+.4g} m to z"
    elif BOUNCE_RANGE[0] < median[2] < BOUNCE_RANGE[1] and wrong < 2 * WRONG * bounces:
        return
    if not BOUNCE_RANGE[0] < median[2] < BOUNCE_RANGE[1]:
        raise ValueError(
            f"{source}: balls bounce at z = {median[2]:.3f} m; in the table frame the ball's centre bounces at "
            f"z = {BALL_RADIUS} m ({hint})"
        )
    raise ValueError(
        f"{source}: {wrong} of {bounces} bounces lie beside the table, {low} balls pass below the net; the median "
        f"bounce is at x = {median[0]:.2f}, y = {median[1]:.2f} m, the table reaches to {TABLE_WIDTH / 2:.2f} and "
        f"{TABLE_LENGTH / 2:.2f} m from its centre ({hint})"
    )


def _acceleration(t: Trajectory) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Median second derivative [m/s^2] of a trajectory, as it is and with the drag of its speed taken off."""
    n = len(t)
    step = float(np.median(np.diff(t.time)))
    w = int(np.clip(round(SPAN / step), 2, (n - 1) // 2))
    a, b, c = slice(0, n - 2 * w), slice(w, n - w), slice(2 * w, n)
    p, time = t.position, t.time
    first = (p[:, b] - p[:, a]) / (time[b] - time[a])
    second = (p[:, c] - p[:, b]) / (time[c] - time[b])
    bend = 2.0 * (second - first) / (time[c] - time[a])
    velocity = 0.5 * (first + second)
    fall = bend + DRAG * np.linalg.norm(velocity, axis=0) * velocity
    return np.median(bend, axis=1), np.median(fall, axis=1)


def _signs(tracks: Sequence[Track]) -> _Signs:
    bounces = [j.place for t in tracks for chain in t.chains for j in chain.junctions if j.bounces and j.miss < 0.15]
    paths = [t.trajectory.position[:, arc] for t in tracks for chain in t.chains for arc in chain.arcs]
    return _Signs(np.array(bounces).reshape(-1, 3).T, tuple(paths))
