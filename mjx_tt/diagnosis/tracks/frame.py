"""Frame of measured balls: units, axes and origin, from how they fall, where they bounce and where they travel.

All figures are medians over a log's pieces, so that wild samples, hits and swapped ids do not move them. Drag is taken
off before a fall is judged: from 8.5 m/s on it exceeds gravity.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float

from ballmodel.constants import BALL_RADIUS, TABLE_HEIGHT, TABLE_LENGTH, TABLE_WIDTH
from ballmodel.table_frame import MARGIN, Signs, acceleration, describe_fall
from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.tracks.chains import Track, take_apart

FEWEST = 8  # samples of a trajectory that tells anything
WRONG = 0.25  # share of bounces and passages over the net that do not fit, from which the frame is another
FITS = 0.15  # share up to which another frame explains a log
MOST = 200  # trajectories looked at, spread over the log


class _Signs(Signs):
    """Bounces and paths of a log in some frame."""

    def moved(self, frame: Frame) -> _Signs:
        """The same in the table frame, if they are in ``frame``."""
        return _Signs(frame.to_table(self.bounces), tuple(map(frame.to_table, self.paths)))

    def misfit(self) -> tuple[int, int]:
        """Bounces that lie neither on the table nor on the floor, and balls that pass below the net's edge."""
        return int(self.off().sum()), self.low()

    def share(self) -> float:
        """``misfit`` as a share of all bounces and passages."""
        return sum(self.misfit()) / max(self.bounces.shape[1] + self.passages(), 1)

    def oddness(self) -> tuple[float, float]:
        """Distance [m] of the middle of play from the net, in halves, and share of balls that do not fly towards -y."""
        if not self.paths:
            return 0.0, 0.0
        middle = np.median(np.concatenate(self.paths, axis=1)[:2], axis=1)
        return round(float(np.hypot(*middle)) / 0.5) * 0.5, float(np.mean([p[1, -1] >= p[1, 0] for p in self.paths]))


@dataclass(frozen=True)
class Frame:
    """A frame that trackers use: the table's own, turned about z by quarters, from another origin."""

    words: tuple[str, ...]  # that name it, of FRAMES
    quarters: int
    shift: tuple[float, float, float]  # [m] added to turned coordinates

    def to_table(self, position: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
        x, y, z = position
        for _ in range(self.quarters):
            x, y = -y, x
        return np.stack([x, y, z]) + np.array(self.shift)[:, None]

    def __str__(self) -> str:
        turned = f"turned by {90 * self.quarters} degrees about z, " if self.quarters else ""
        return f"{', '.join(self.words) or 'table'} ({turned}{', '.join(f'{s:+.4g}' for s in self.shift)} m added)"


FRAMES = {
    "corner": "the origin is a corner of the table",
    "end": "the origin is the middle of an end line",
    "side": "the origin is the middle of a side line",
    "floor": "z is measured from the floor",
    "x-along": "x runs along the table",
}


def _frames() -> Iterator[Frame]:
    half = TABLE_WIDTH / 2, TABLE_LENGTH / 2
    for quarters in (0, 2, 1, 3):  # the fewest changes first
        for above in (0.0, -TABLE_HEIGHT):
            for a, b in product((0, -1, 1), repeat=2):
                place = () if not (a or b) else ("corner",) if a and b else ("side",) if a else ("end",)
                words = (*place, *(("floor",) if above else ()), *(("x-along",) if quarters % 2 else ()))
                yield Frame(words, quarters, (a * half[0], b * half[1], above))


def align(
    trajectories: Sequence[Trajectory], source: str, frame: str | None = None
) -> tuple[tuple[Trajectory, ...], tuple[str, ...]]:
    """Trajectories in the table frame, and what was done to bring them there.

    The frame is told by how balls fall, where they bounce and where they pass the net. Coordinates that fit the table
    frame stay as they are. A frame that is turned by 180 degrees looks the same; balls then fly towards -y mostly.

    Args:
        trajectories: in metres and seconds.
        source: for messages.
        frame: words of FRAMES joined by "+", or "table", where it is known.

    Raises:
        ValueError: the balls do not fall along -z, or no frame explains where they bounce.
    """
    if not trajectories:
        raise ValueError(f"{source}: holds no trajectory")
    words = None if frame is None else set(frame.split("+")) - {"table"}
    if words is not None and not words <= FRAMES.keys():
        raise ValueError(f"frame: expected table, or words of {', '.join(FRAMES)} joined by +, got {frame!r}")
    long = [t for t in trajectories if len(t) >= FEWEST]
    if not long:
        raise ValueError(f"{source}: no trajectory has {FEWEST} samples, the longest has {max(map(len, trajectories))}")
    long = long[:: -(-len(long) // MOST)]
    bend, fall = (np.median(a, axis=0) for a in zip(*(acceleration(t.time, t.position) for t in long), strict=True))
    signs = _signs([take_apart(t) for t in long])
    bounces = signs.bounces.shape[1]
    many = bounces >= max(3, 0.2 * len(long))
    if not (many and signs.misfit()[0] < 0.1 * bounces) and (wrong := describe_fall(bend, fall)):
        raise ValueError(f"{source}: {wrong}")
    travel = np.median([np.ptp(np.percentile(t.position, [5, 95], axis=1), axis=0) for t in long], axis=0)
    across = bool(travel[0] > 2.0 * travel[1])
    chosen = _choose(signs, across, words) if many or words is not None else Frame((), 0, (0.0, 0.0, 0.0))
    if chosen is None or (chosen.quarters == 0 and across):
        raise ValueError(_describe(signs, travel, source))
    middle = np.median(np.concatenate([chosen.to_table(t.position) for t in long], axis=1), axis=1)
    if abs(middle[0]) > 1.5 or abs(middle[1]) > 2.5:
        raise ValueError(
            f"{source}: the balls' middle is x = {middle[0]:.2f}, y = {middle[1]:.2f} m, far from the table's centre "
            "(another frame?)"
        )
    if not chosen.quarters and not any(chosen.shift):
        return tuple(trajectories), ()
    note = f"{source}: coordinates were brought into the table frame from the frame {chosen}"
    return tuple(replace(t, position=chosen.to_table(t.position)) for t in trajectories), (note,)


def _choose(signs: _Signs, across: bool, words: set[str] | None) -> Frame | None:
    """The frame in which bounces and passages over the net are where table and net are."""
    found: list[tuple[float, tuple[float, float], int, Frame]] = []
    for frame in _frames():
        if (words is not None and set(frame.words) != words) or (words is None and across == (frame.quarters % 2 == 0)):
            continue
        moved = signs.moved(frame)
        bounces = max(signs.bounces.shape[1], 1)
        wrong, share = moved.misfit()[0] / bounces, moved.share()
        x, y, _ = moved.bounces
        quarter = not frame.words and np.mean((x > -MARGIN) & (y > -MARGIN)) > 0.95 and share > WRONG
        if not frame.quarters and not frame.words and wrong < WRONG and not quarter:
            return frame
        found.append((share, moved.oddness(), len(found), frame))
    if not found:
        return None
    best = min(share for share, *_ in found)
    if words is None and best > FITS:
        return None
    return min((entry for entry in found if entry[0] <= max(best, FITS)), key=lambda entry: entry[1:3])[3]


def _describe(signs: _Signs, travel: Float[np.ndarray, "3"], source: str) -> str:
    """What is wrong with a log's frame."""
    wrong, low = signs.misfit()
    x, y, z = np.median(signs.bounces, axis=1) if signs.bounces.size else np.full(3, np.nan)
    return (
        f"{source}: {wrong} of {signs.bounces.shape[1]} bounces lie beside the table, {low} balls pass below the net; "
        f"the median bounce is at x = {x:.2f}, y = {y:.2f}, z = {z:.3f} m, and balls travel {travel[0]:.2f} m along x "
        f"and {travel[1]:.2f} m along y. Expected the table frame: its origin at the table's centre, y along the "
        f"table, bounces at z = {BALL_RADIUS} m. Convert the coordinates, or name the frame: --frame {'+'.join(FRAMES)}"
    )


def _signs(tracks: Sequence[Track]) -> _Signs:
    bounces = [j.place for t in tracks for chain in t.chains for j in chain.junctions if j.bounces and j.miss < 0.15]
    paths = [t.trajectory.position[:, arc] for t in tracks for chain in t.chains for arc in chain.arcs]
    return _Signs(np.array(bounces).reshape(-1, 3).T, tuple(paths))
