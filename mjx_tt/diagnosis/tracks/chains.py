"""Chains: the arcs that one ball flew one after the other, and what it met between them.

Two arcs belong to one ball where they meet in place and time. What the ball met there follows from the place and from
the change of its velocity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from ballmodel.constants import BALL_RADIUS, TABLE_HEIGHT
from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.tracks.arcs import GATE, MATURE, PATIENCE, End, arcs, noise_of

MEETING = 0.08  # [m] between two arcs that meet
TURN = 6.0  # [m/s^2] by which an arc's own acceleration may mislead through a gap
NEAR_TABLE = (-0.08, 0.15)  # [m] height of the ball's centre at a bounce on the table
FLOOR = BALL_RADIUS - TABLE_HEIGHT  # [m] height of the ball's centre on the floor
NEAR_FLOOR = 0.25  # [m] above it
NET_ZONE = (0.10, 0.22)  # [m] |y| and z of a ball that touches the net
LIKE_A_BOUNCE = 0.75  # least share of the kick that is vertical
SAME_FLIGHT = 1.2  # [m/s] change of velocity that needs no cause
FASTEST = 15.0  # [m/s] of a ball between two arcs that do not meet

STRAYS = 3  # samples that an arc may have behind the beginning of the next one

Met: TypeAlias = Literal["nothing", "table", "floor", "net", "racket", "jump"]


@dataclass(frozen=True)
class Junction:
    """Meeting of two arcs."""

    met: Met
    time: float  # [s]
    place: Float[np.ndarray, "3"]  # [m]
    miss: float  # [m] distance between the arcs there
    before: Float[np.ndarray, "3"]  # [m/s]
    after: Float[np.ndarray, "3"]  # [m/s]

    @property
    def bounces(self) -> bool:
        """True where the velocity's change is that of a bounce on something level, at whatever height."""
        kick = self.after - self.before
        down, up = self.before[2] < 0.0, self.after[2] > -0.2
        return bool(down and up and kick[2] > max(LIKE_A_BOUNCE * np.linalg.norm(kick), 0.5))


@dataclass
class Chain:
    """Arcs of one ball within a track."""

    track: int
    arcs: list[Int[np.ndarray, " k"]]  # samples of the track, each arc's cut at its junctions
    junctions: list[Junction] = field(default_factory=list)  # one fewer than arcs

    @property
    def samples(self) -> Int[np.ndarray, " k"]:
        """All samples of the chain."""
        return np.concatenate(self.arcs)


@dataclass(frozen=True)
class Track:
    """A trajectory taken apart."""

    trajectory: Trajectory
    noise: float  # [m]
    chains: list[Chain]  # by their first samples
    wild: Int[np.ndarray, " m"]  # samples of no chain


def junction(a: End, b: End, start: float, stop: float, noise: float, gap: float) -> Junction:
    """Meeting of an arc that goes on as ``a`` with one that came as ``b``, between two times [s].

    gap: [s] between the samples of the two.
    """
    time = np.linspace(start, stop, 61)
    apart = np.linalg.norm(a.position(time) - b.position(time), axis=0)
    k = int(np.argmin(apart))
    at, miss = float(time[k]), float(apart[k])
    place = 0.5 * (a.position(at) + b.position(at))[:, 0]
    before, after = a.velocity(at), b.velocity(at)
    found = Junction("nothing", at, place, miss, before, after)
    allowed = MEETING + 6.0 * noise + 0.5 * TURN * gap**2
    if miss > allowed:
        met: Met = "racket" if miss < allowed + FASTEST * gap else "jump"
    elif np.linalg.norm(after - before) < SAME_FLIGHT + TURN * gap:
        met = "nothing"
    elif found.bounces and NEAR_TABLE[0] - 3 * noise < place[2] < NEAR_TABLE[1] + 3 * noise:
        met = "table"
    elif place[2] < FLOOR + NEAR_FLOOR:
        met = "floor"
    elif abs(place[1]) < NET_ZONE[0] and place[2] < NET_ZONE[1]:
        met = "net"
    else:
        met = "racket"
    return Junction(met, at, place, miss, before, after)


def take_apart(trajectory: Trajectory, index: int = 0, noise: float | None = None) -> Track:
    """The chains of a trajectory; ``index`` is its number, which they keep.

    noise: [m] deviation of a sample; from the trajectory itself without it.
    """
    noise = noise_of(trajectory.position) if noise is None else noise
    time, position = trajectory.time, trajectory.position
    runs = arcs(time, position, noise)
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    chains: list[Chain] = []
    for run in runs:
        best: tuple[float, Chain, Junction, tuple[np.ndarray, np.ndarray]] | None = None
        for chain in chains:
            pair = _apart(chain.arcs[-1], run)
            if pair is None or (gap := float(time[pair[1][0]] - time[pair[0][-1]])) > PATIENCE:
                continue
            last, later = pair
            course = End.of(time[last], position[:, last], noise, True)
            first = End.of(time[later], position[:, later], noise, False)
            earliest = max(time[last[-1]] - 5.0 * step, time[last[0]])
            latest = min(time[later[0]] + 2.0 * step, time[later[-1]])
            found = junction(course, first, earliest, latest, noise, max(gap - 2.0 * step, 0.0))
            if found.met != "jump" and (best is None or found.miss < best[0]):
                best = (found.miss, chain, found, pair)
        if best is None:
            chains.append(Chain(index, [run]))
            continue
        _, chain, found, pair = best
        both = np.concatenate(pair)
        chain.arcs[-1] = both[time[both] < found.time]
        chain.arcs.append(both[time[both] >= found.time])
        chain.junctions.append(found)
        _drop_empty(chain)
    _attach(trajectory, chains, noise, step)
    kept = np.concatenate([c.samples for c in chains]) if chains else np.zeros(0, int)
    wild = np.setdiff1d(np.arange(len(trajectory)), kept)
    return Track(trajectory, noise, sorted(chains, key=lambda c: int(c.arcs[0][0])), wild)


def _apart(
    arc: Int[np.ndarray, " k"], later: Int[np.ndarray, " m"]
) -> tuple[Int[np.ndarray, " i"], Int[np.ndarray, " j"]] | None:
    """Two arcs without the few wild samples that make them overlap; None where many do: two balls at once."""
    behind, ahead = arc[arc > later[0]], later[later < arc[-1]]
    if min(behind.size, ahead.size) > STRAYS:
        return None
    if behind.size <= ahead.size:
        arc = arc[arc < later[0]]
    else:
        later = later[later > arc[-1]]
    return (arc, later) if min(arc.size, later.size) >= 2 else None


def _drop_empty(chain: Chain) -> None:
    """Joins an arc that its junctions left without samples to the one before it."""
    for k in reversed(range(len(chain.arcs))):
        if chain.arcs[k].size == 0 and len(chain.arcs) > 1:
            del chain.arcs[k]
            del chain.junctions[max(k - 1, 0)]


def _attach(trajectory: Trajectory, chains: Sequence[Chain], noise: float, step: float) -> None:
    """Gives the chains back the few samples around their junctions and ends that no arc expected."""
    time, position = trajectory.time, trajectory.position
    free = np.ones(len(time), bool)
    for chain in chains:
        free[chain.samples] = False
    close = max(GATE, 6.0 * noise)
    for chain in chains:
        rebounds: list[tuple[bool, np.ndarray, Junction]] = []
        for k, arc in enumerate(chain.arcs):
            # A junction rounds off or falls between samples: nearer to it a sample may be farther off.
            for last in (False, True):
                edge = time[arc[-1 if last else 0]]
                reach = 1.5 * MATURE * step
                low, high = (edge, edge + reach) if last else (edge - reach, edge)
                between = k + 1 < len(chain.arcs) if last else k > 0
                near = np.flatnonzero(free & (time >= low) & (time <= high))
                if not near.size:
                    continue
                expected = End.of(time[arc], position[:, arc], noise, last).position(time[near])
                under = (expected[2] < BALL_RADIUS) & (np.abs(expected[2]) < 4.0 * MEETING)
                if under.any() and position[2, arc].max() > BALL_RADIUS:  # too short a rebound to be an arc
                    expected[2, under] = 2.0 * BALL_RADIUS - expected[2, under]
                off = np.linalg.norm(position[:, near] - expected, axis=0)
                mine = near[off < (MEETING if between or under.any() else close)]
                free[mine] = False
                if mine.size and under.any() and not between:
                    place = position[:, mine[0 if last else -1]]
                    met = Junction("table", float(time[mine[0 if last else -1]]), place, 0.0, place * 0.0, place * 0.0)
                    rebounds.append((last, mine, met))
                else:
                    chain.arcs[k] = arc = np.union1d(arc, mine)
        for last, mine, met in rebounds:
            chain.arcs.insert(len(chain.arcs) if last else 0, mine)
            chain.junctions.insert(len(chain.junctions) if last else 0, met)
