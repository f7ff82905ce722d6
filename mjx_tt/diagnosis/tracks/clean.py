"""Cleaning of measured balls: strokes out of tracks, and a record of everything that was taken out or parted.

A track is what a tracker calls one ball. It may hold wild samples, another ball, several strokes, a ball in the hand or
on the floor; its id may have jumped to another ball. A stroke is one ball's flight from a racket, or from where it was
first seen, to the next thing that is not the table. A track that is one clean stroke stays the object that it was.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from typing import Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from ballmodel.constants import GRAVITY
from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.tracks.arcs import PATIENCE, End, noise_of
from mjx_tt.diagnosis.tracks.chains import Chain, Junction, Track, junction, take_apart

FEWEST = 8  # samples of a stroke
WINDOW = 0.20  # [s] over which an acceleration is judged
RESTING = -3.0  # [m/s^2] upwards, beyond which nothing flies: backspin takes at most two thirds of gravity
RESTING_SIGMA = 5.0
EDGE = 3  # samples of an arc next to a bounce, which may not be free flight
SWAP_GAP = 0.10  # [s] within which a ball goes on under another id

Kind: TypeAlias = Literal[
    "outlier", "repeat", "swap", "jump", "two balls", "rally", "racket", "net", "floor", "not in flight", "fragment"
]
KINDS: tuple[str, ...] = get_args(Kind)
MEANINGS: dict[str, str] = {
    "outlier": "samples off every flight",
    "repeat": "samples that repeat the position before them",
    "swap": "ids that two balls exchanged; mended",
    "jump": "ids that went on to another ball; parted",
    "two balls": "ids that hold two balls at once; parted",
    "rally": "strokes of one track; parted",
    "racket": "strokes that begin at a racket inside a track; left out",
    "net": "flights after a touch of the net; left out",
    "floor": "flights after the floor; left out",
    "not in flight": "balls in a hand, rolling or at rest; left out",
    "fragment": f"flights of fewer than {FEWEST} samples; left out",
}


@dataclass(frozen=True)
class Entry:
    """One thing that was done to one track."""

    kind: Kind
    trajectory: str  # label of the track
    time: float  # [s] of the track at which it begins
    text: str
    position: Float[np.ndarray, "3 k"] = field(default_factory=lambda: np.zeros((3, 0)))  # [m] taken out

    @property
    def samples(self) -> int:
        """Number of samples taken out."""
        return self.position.shape[1]

    def __str__(self) -> str:
        return f"{self.trajectory}, t = {self.time:.3f} s: {self.text}"


@dataclass(frozen=True)
class Record:
    """Everything that cleaning did."""

    entries: tuple[Entry, ...]
    given: int  # tracks
    kept: int  # strokes
    tracks: tuple[Trajectory, ...]  # mended, but not parted at rackets: a hit and its return in one

    def of(self, kind: str) -> tuple[Entry, ...]:
        """Entries of one of KINDS."""
        return tuple(e for e in self.entries if e.kind == kind)

    @property
    def labels(self) -> tuple[str, ...]:
        """Tracks that were touched."""
        return tuple(dict.fromkeys(e.trajectory for e in self.entries))

    def lines(self, most: int = 6) -> list[str]:
        """One line for each kind, naming up to ``most`` of its tracks."""
        out = []
        for kind in KINDS:
            found = self.of(kind)
            if not found:
                continue
            names = list(dict.fromkeys(e.trajectory.removeprefix("trajectory ") for e in found))
            more = f" and {len(names) - most} more" if len(names) > most else ""
            samples = sum(e.samples for e in found)
            taken = f", {samples} samples taken out" if samples else ""
            out.append(f"{MEANINGS[kind]}: {len(found)}{taken} ({', '.join(names[:most])}{more})")
        return out


def clean(trajectories: Sequence[Trajectory], rallies: bool = True) -> tuple[tuple[Trajectory, ...], Record]:
    """The strokes in measured tracks in the table frame, and the record of what was done to get them.

    Strokes keep their track's name; the second one of a track is ``name/2``. rallies: strokes that begin at a racket
    inside a track are kept; without, they are left out (their balls spin), and the record says so.
    """
    entries: list[Entry] = []
    moving = [_without_repeats(t, entries) for t in trajectories]
    noises = [noise_of(t.position) for t in moving]
    most = 3.0 * float(np.median(noises)) if noises else 0.0  # two balls in one track look like noise
    tracks = [take_apart(t, i, min(noise, most)) for i, (t, noise) in enumerate(zip(moving, noises, strict=True))]
    for track in tracks:
        _note_wild(track, entries)
    strokes: list[Trajectory] = []
    mended: list[Trajectory] = []
    balls = _balls(tracks, entries)
    for track, own in zip(tracks, balls, strict=True):
        name, parts = track.trajectory.name, 0
        for ball in own:
            whole = ball.trajectory(name)
            if len(whole) >= FEWEST:
                mended.append(_same(whole, trajectories[track.chains[0].track] if track.chains else None))
            for stroke in _strokes(ball, track, entries, rallies):
                parts += 1
                named = stroke if parts == 1 else replace(stroke, name=f"{name}/{parts}")
                strokes.append(_same(named, trajectories[ball.track]))
    order = {kind: k for k, kind in enumerate(KINDS)}
    entries.sort(key=lambda e: order[e.kind])
    return tuple(strokes), Record(tuple(entries), len(trajectories), len(strokes), tuple(mended))


def _same(new: Trajectory, old: Trajectory | None) -> Trajectory:
    """The trajectory that was given where nothing of it changed."""
    same = old is not None and new.name == old.name and np.array_equal(new.position, old.position)
    return old if old is not None and same else new


def _without_repeats(t: Trajectory, entries: list[Entry]) -> Trajectory:
    """Without samples that repeat the one before: a tracker that hangs."""
    again = np.concatenate([[False], np.all(np.diff(t.position, axis=1) == 0.0, axis=0)])
    if not again.any():
        return t
    first = float(t.time[np.argmax(again)])
    text = f"{int(again.sum())} samples repeat the position before them"
    entries.append(Entry("repeat", t.label, first, text, t.position[:, again]))
    return Trajectory(t.session, t.name, t.time[~again], t.position[:, ~again])


def _note_wild(track: Track, entries: list[Entry]) -> None:
    t, wild = track.trajectory, track.wild
    if wild.size:
        text = f"{wild.size} of {len(t)} samples lie off every flight"
        entries.append(Entry("outlier", t.label, float(t.time[wild[0]]), text, t.position[:, wild]))


# --- balls: chains joined across ids


@dataclass
class _Ball:
    """Pieces of one ball, each of a track; the junctions between their arcs."""

    track: int
    session: str
    pieces: list[tuple[Trajectory, Chain]]
    joints: list[Junction] = field(default_factory=list)  # between pieces

    def arcs(self) -> list[tuple[Float[np.ndarray, " k"], Float[np.ndarray, "3 k"]]]:
        """Times and positions of the arcs."""
        return [(t.time[a], t.position[:, a]) for t, chain in self.pieces for a in chain.arcs]

    def junctions(self) -> list[Junction]:
        """Junctions between the arcs, in their order."""
        out: list[Junction] = []
        for k, (_, chain) in enumerate(self.pieces):
            out += ([self.joints[k - 1]] if k else []) + chain.junctions
        return out

    def trajectory(self, name: str) -> Trajectory:
        """The whole ball."""
        parts = self.arcs()
        return _joined(self.session, name, parts)


def _joined(session: str, name: str, parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> Trajectory:
    time, position = np.concatenate([t for t, _ in parts]), np.concatenate([p for _, p in parts], axis=1)
    later = _later(parts)
    return Trajectory(session, name, time[later], position[:, later])


def _later(parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> Bool[np.ndarray, " n"]:
    """Samples of all parts that come after those before them.

    Stamps may cross where one part takes over from the other: of two ids, or where stamps shake.
    """
    time = np.concatenate([t for t, _ in parts])
    return np.concatenate([[True], np.diff(np.maximum.accumulate(time)) > 0.0])


def _balls(tracks: Sequence[Track], entries: list[Entry]) -> list[list[_Ball]]:
    """The balls that each track holds first; chains that go on under another id are joined."""
    follows = _swaps(tracks)
    taken = {(j, c) for j, c, _ in follows.values()}
    out: list[list[_Ball]] = []
    for i, track in enumerate(tracks):
        t, own = track.trajectory, []
        for c, chain in enumerate(track.chains):
            if (i, c) in taken:
                continue
            ball = _Ball(i, t.session, [(t, chain)])
            here = (i, c)
            while here in follows:
                j, d, met = follows[here]
                other = tracks[j].trajectory
                ball.pieces.append((other, tracks[j].chains[d]))
                ball.joints.append(met)
                text = f"the ball goes on as {other.label}; joined"
                entries.append(Entry("swap", tracks[here[0]].trajectory.label, met.time, text))
                here = (j, d)
            own.append(ball)
        _note_parted(track, [c for c in range(len(track.chains)) if (i, c) not in taken], entries)
        out.append(own)
    return out


def _note_parted(track: Track, own: list[int], entries: list[Entry]) -> None:
    """Names the tracks whose chains are several balls' own."""
    t = track.trajectory
    for before, after in pairwise(own):
        a, b = track.chains[before].samples, track.chains[after].samples
        at = float(t.time[b[0]])
        if t.time[b[0]] < t.time[a[-1]]:
            text = f"two balls at once, of {a.size} and {b.size} samples; parted"
            entries.append(Entry("two balls", t.label, at, text))
        else:
            leap = float(np.linalg.norm(t.position[:, b[0]] - t.position[:, a[-1]]))
            gap = f" after {at - t.time[a[-1]]:.2f} s without a sample" if at - t.time[a[-1]] > PATIENCE else ""
            entries.append(Entry("jump", t.label, at, f"goes on {leap:.2f} m away{gap}: another ball; parted"))


def _goes_on(here: Track, arc: Int[np.ndarray, " k"], there: Track, later: Int[np.ndarray, " m"]) -> Junction | None:
    """Junction of an arc with a later one of another track, where a ball's flight or a bounce joins them."""
    a, b, noise = here.trajectory, there.trajectory, max(here.noise, there.noise)
    last, first = float(a.time[arc[-1]]), float(b.time[later[0]])
    if not -0.03 < first - last < SWAP_GAP:
        return None
    course = End.of(a.time[arc], a.position[:, arc], noise, True)
    came = End.of(b.time[later], b.position[:, later], noise, False)
    met = junction(course, came, min(first, last) - 0.01, max(first, last) + 0.01, noise, 0.0)
    return met if met.met in ("nothing", "table") else None


def _swaps(tracks: Sequence[Track]) -> dict[tuple[int, int], tuple[int, int, Junction]]:
    """Chain -> the chain of another track of the session that its ball flies on as.

    Only chains that end, or begin, within their track count, and only where the flight or a bounce goes on.
    """
    ends = [(i, c) for i, t in enumerate(tracks) for c in range(len(t.chains) - 1)]
    starts = [(i, c) for i, t in enumerate(tracks) for c in range(1, len(t.chains))]
    found: list[tuple[float, tuple[int, int], tuple[int, int], Junction]] = []
    for (i, c), (j, d) in product(ends, starts):
        if i == j or tracks[i].trajectory.session != tracks[j].trajectory.session:
            continue
        met = _goes_on(tracks[i], tracks[i].chains[c].arcs[-1], tracks[j], tracks[j].chains[d].arcs[0])
        if met is not None:
            found.append((met.miss, (i, c), (j, d), met))
    out: dict[tuple[int, int], tuple[int, int, Junction]] = {}
    used: set[tuple[int, int]] = set()
    for _, end, start, met in sorted(found, key=lambda f: f[0]):
        if end not in out and start not in used:
            out[end] = (*start, met)
            used.add(start)
    return out


# --- strokes: a ball's flight from racket to racket


def _strokes(ball: _Ball, track: Track, entries: list[Entry], rallies: bool) -> Iterable[Trajectory]:
    label = track.trajectory.label
    groups: list[list[tuple[np.ndarray, np.ndarray]]] = [[]]
    begins: list[Junction | None] = [None]
    arcs, met = ball.arcs(), ball.junctions()
    for k, arc in enumerate(arcs):
        if k and met[k - 1].met not in ("nothing", "table"):
            groups.append([])
            begins.append(met[k - 1])
        groups[-1].append(arc)
    whole = len(arcs) > 0 and len(groups) == 1
    over: str | None = None
    for number, (group, begin) in enumerate(zip(groups, begins, strict=True), start=1):
        at, samples = float(group[0][0][0]), np.concatenate([p for _, p in group], axis=1)
        if begin is not None and begin.met in ("floor", "net"):
            over = begin.met
        elif begin is not None and over == "net":
            over = None
        if over is not None:
            where = {"floor": "after the floor", "net": "after touching the net"}[over]
            kind: Kind = "floor" if over == "floor" else "net"
            entries.append(Entry(kind, label, at, f"{samples.shape[1]} samples {where}", samples))
            continue
        if begin is not None and not rallies:
            text = f"stroke {number} begins at a racket, its ball spins: {samples.shape[1]} samples left out"
            entries.append(Entry("racket", label, at, text, samples))
            continue
        stroke = _joined(ball.session, track.trajectory.name, group)
        flown = _in_flight(group, track.noise)[_later(group)]
        if flown.sum() < len(stroke):
            text = f"{int((~flown).sum())} samples of a ball that does not fly (in a hand, rolling, at rest)"
            gone = stroke.position[:, ~flown]
            entries.append(Entry("not in flight", label, float(stroke.time[np.argmax(~flown)]), text, gone))
            stroke = _chosen(stroke, flown) if flown.any() else stroke.part(0, 1)
            if not flown.any():
                continue
        if len(stroke) < FEWEST and not (whole and len(stroke) == len(track.trajectory)):
            text = f"a flight of {len(stroke)} samples"
            entries.append(Entry("fragment", label, at, text, stroke.position))
            continue
        if begin is not None:
            entries.append(Entry("rally", label, at, f"stroke {number} begins at a racket; parted"))
        yield stroke


def _chosen(t: Trajectory, keep: np.ndarray) -> Trajectory:
    return Trajectory(t.session, t.name, t.time[keep], t.position[:, keep])


def _in_flight(arcs: Sequence[tuple[np.ndarray, np.ndarray]], noise: float) -> Bool[np.ndarray, " n"]:
    """(n,) samples of a stroke's arcs between the ball's release and its rest.

    Judged by the upward acceleration over windows within an arc; what lies between the first and the last window that
    flies counts as flown. One window alone proves no rest.
    """
    flies: list[tuple[int, int]] = []
    before, longest, resting = 0, 0, 0
    for time, position in arcs:
        inner = slice(EDGE, len(time) - EDGE)
        resting = 0
        for low, high in _windows(time[inner]):
            low, high = low + EDGE, high + EDGE
            lift, error = _lift(time[low:high], position[2, low:high], noise)
            if lift > RESTING and lift + GRAVITY > RESTING_SIGMA * error:
                resting = max(resting, 0) + 1
                longest = max(longest, resting)
            else:
                resting = -1
                flies.append((before + low, before + high))
        longest = max(longest, 2 * (resting > 0))  # an arc that rests in all its windows, be it one
        before += len(time)
    keep = np.ones(before, bool)
    if longest < 2:
        return keep
    keep[:] = False
    if flies:
        first, last = flies[0][0], flies[-1][1]
        keep[(0 if first <= EDGE else first) : (before if last >= before - EDGE else last)] = True
    return keep


def _windows(time: Float[np.ndarray, " n"]) -> Iterable[tuple[int, int]]:
    """First and last + 1 sample of half overlapping windows with samples enough."""
    if len(time) < 10:
        return
    for start in np.arange(time[0], time[-1] - 0.8 * WINDOW, 0.5 * WINDOW):
        low, high = (int(k) for k in np.searchsorted(time, [start, start + WINDOW]))
        if high - low >= 10:
            yield low, high


def _lift(time: Float[np.ndarray, " k"], z: Float[np.ndarray, " k"], noise: float) -> tuple[float, float]:
    """Upward acceleration [m/s^2] of a window and its standard error, with some room for noise that remembers."""
    d = time - time.mean()
    powers = np.stack([np.ones_like(d), d, 0.5 * d * d], axis=1)
    inverse = np.linalg.inv(powers.T @ powers)
    return float((inverse @ (powers.T @ z))[2]), 1.5 * noise * float(np.sqrt(inverse[2, 2]))
