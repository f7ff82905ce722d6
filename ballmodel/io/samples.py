"""Samples of a tracker put in order: what was lost dropped, units found, balls under one id parted.

Trackers write what they saw when they saw it. A trajectory of this project is one ball in seconds and metres with
increasing times. Everything that is done on the way is said in the data set's notes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from ballmodel.constants import GRAVITY
from ballmodel.table_frame import differentiate_twice
from ballmodel.trajectory import Dataset, Trajectory

LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}  # [m]
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # [s]
FRAMES = "frames"
RATES = (24, 25, 30, 48, 50, 60, 75, 90, 100, 120, 125, 150, 180, 200, 240, 250, 300, 400, 500, 1000)  # [Hz] of cameras
RATE_ERROR = 0.08  # of a camera's rate told by the balls' fall, which drag and lift change by a few per cent
ONE_FLIGHT = 2.5  # [s] that a ball may fly; longer tracks hold several
SILENCE, SILENT_SAMPLES = 0.09, 6.0  # [s] and sampling intervals without a sample that part a longer track
REACH = 0.3  # [m] from where a ball was expected, beyond which a sample is another ball's


@dataclass(frozen=True)
class TrackOptions:
    """What a person knows about a file. All of it is found out where it is not given.

    Attributes:
        columns: ours (session, trajectory, t, x, y, z) -> the file's.
        length: unit of the positions, one of LENGTHS.
        time: unit of the times, one of TIMES, or FRAMES.
        rate: frames a second, where times are numbers of frames.
        topic: of the messages that hold the ball.
        salvage: whether a log that is damaged or cut short is read up to there.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    length: str | None = None
    time: str | None = None
    rate: float | None = None
    topic: str | None = None
    salvage: bool = False

    def __post_init__(self) -> None:
        for name, value, allowed in (("length", self.length, LENGTHS), ("time", self.time, (*TIMES, FRAMES))):
            if value is not None and value not in allowed:
                raise ValueError(f"unit of {name}: expected one of {', '.join(allowed)}, got {value!r}")
        if self.rate is not None and not 1.0 <= self.rate <= 1e5:
            raise ValueError(f"frames a second: expected 1 to 100000, got {self.rate:g}")


@dataclass(frozen=True)
class Samples:
    """Rows of a file: NaN where a number is missing."""

    time: Float[np.ndarray, " n"]
    position: Float[np.ndarray, "3 n"]
    session: list[str]
    track: list[str]  # "" where the file names none
    notes: tuple[str, ...] = ()
    length: str | None = None  # units that the file tells
    time_unit: str | None = None


Track: TypeAlias = tuple[Float[np.ndarray, " k"], Float[np.ndarray, "3 k"]]  # times [s], positions [m]
Tracks: TypeAlias = Mapping[tuple[str, str], Track]  # of session and name


def make_dataset(samples: Samples, source: str, options: TrackOptions) -> Dataset:
    """Trajectories in metres and seconds.

    Raises:
        ValueError: nothing is left, or a unit cannot be told; the message says what to give.
    """
    notes = list(samples.notes)
    time, position = np.asarray(samples.time, float), np.asarray(samples.position, float)
    known = np.isfinite(time) & np.isfinite(position).all(axis=0)
    same = known & (position == position[0]).all(axis=0)
    words = "without all their numbers", "with three equal coordinates, which mark no ball"  # 0, 0, 0 or -1, -1, -1
    for lost, why in zip((~known, same), words, strict=True):
        if lost.any():
            notes.append(f"{int(lost.sum())} of {lost.size} rows {why} were left out")
    kept = np.flatnonzero(known & ~same)
    if not kept.size:
        raise ValueError(f"{source}: expected rows with time and position of a ball, got none among {known.size}")
    scale = _find_length(position[:, kept], options.length or samples.length, notes)
    groups: dict[tuple[str, str], list[int]] = {}
    for i in kept.tolist():
        groups.setdefault((samples.session[i], samples.track[i]), []).append(i)
    tracks = {}
    for key, found in groups.items():
        rows = np.array(found)[np.argsort(time[found], kind="stable")]
        tracks[key] = time[rows], scale * position[:, rows]
    unit = _find_time(tracks, options.time or samples.time_unit, options.rate, source, notes)
    trajectories, repeated = [], 0
    for (session, name), (stamps, places) in tracks.items():
        balls = list(_part_balls(unit * stamps, places))
        repeated += stamps.size - sum(t.size for t, _ in balls)
        flights = [flight for ball in balls for flight in _part_silences(*ball)]
        for number, (t, p) in enumerate(flights, start=1):
            label = name if len(flights) == 1 else f"{name}.{number}" if name else str(number)
            try:
                trajectories.append(Trajectory(session, label, t, p))
            except ValueError as error:
                raise ValueError(f"{source}: {error}") from None
    if repeated:
        notes.append(f"{repeated} samples that repeat a time were left out")
    if len(trajectories) > len(tracks):
        notes.append(f"{len(tracks)} tracks hold {len(trajectories)} flights, parted where the ball was unseen")
    return Dataset(tuple(trajectories), source, tuple(notes))


def _find_length(position: Float[np.ndarray, "3 n"], told: str | None, notes: list[str]) -> float:
    """Metres of one unit: balls are a few metres, hundreds of centimetres, thousands of millimetres from any origin."""
    if told is None:
        far = float(np.median(np.abs(position).max(axis=0)))
        told = "m" if far < 20.0 else "cm" if far < 400.0 else "mm"
        if told != "m":
            notes.append(f"positions were taken for {told}: half of the samples are {far:.0f} and more from the origin")
    return LENGTHS[told]


def _find_time(tracks: Tracks, told: str | None, rate: float | None, source: str, notes: list[str]) -> float:
    """Seconds of one unit, by the time between two samples, which cameras have at 5 to 2,000 Hz."""
    steps = np.concatenate([np.diff(t) for t, _ in tracks.values()])
    steps = steps[steps > 0.0]
    if told is None and not steps.size:
        return 1.0
    step = float(np.median(steps)) if steps.size else 0.0
    whole = all(np.all(t == np.round(t)) for t, _ in tracks.values())
    if told is None and (rate is not None or (whole and step <= 4.0)):
        told = FRAMES
    if told == FRAMES:
        if rate is None:
            rate = _find_rate(tracks, source)
            notes.append(f"times were taken for numbers of frames at {rate:g} Hz, by how the balls fall")
        return 1.0 / rate
    if told is None:
        told = "s" if step < 0.4 else "ms" if step < 400.0 else "us" if step < 4e5 else "ns"
        if told != "s":
            notes.append(f"times were taken for {told}: {step:g} lie between two samples")
    return TIMES[told]


def _find_rate(tracks: Tracks, source: str) -> float:
    """Frames a second from the fall [m / frame^2] of the balls."""
    bends = [np.zeros(0)]
    for time, position in tracks.values():
        w = min(6, (time.size - 1) // 2)
        if w >= 2:
            with np.errstate(divide="ignore", invalid="ignore"):
                bends.append(differentiate_twice(time, position[2], w)[1])
    bend = np.concatenate(bends)
    bend = bend[np.isfinite(bend)]
    fall = -float(np.median(bend)) if bend.size else 0.0
    rate = np.sqrt(GRAVITY / fall) if fall > 0.0 else np.nan
    near = min(RATES, key=lambda r: abs(np.log(r / rate))) if np.isfinite(rate) else 0
    if not near or abs(near / rate - 1.0) > RATE_ERROR:
        raise ValueError(f"{source}: times are numbers of frames; say how many a second there are (--fps 120)")
    return float(near)


def _part_balls(time: Float[np.ndarray, " n"], position: Float[np.ndarray, "3 n"]) -> Iterator[Track]:
    """The balls of one track with increasing times; samples that say the same again are dropped."""
    new = np.diff(time, prepend=-np.inf) > 0.0
    again = np.flatnonzero(~new)
    apart = np.linalg.norm(position[:, again] - position[:, again - 1], axis=0) > 0.02
    if apart.sum() < max(3, 0.05 * time.size):
        yield time[new], position[:, new]
        return
    balls: list[list[int]] = []
    for moment in np.split(np.arange(time.size), np.flatnonzero(new)[1:]):
        open_balls = [ball for ball in balls if time[moment[0]] - time[ball[-1]] < SILENCE]
        left = set(moment.tolist())
        if open_balls:
            expected = np.stack([_extrapolate(time, position, ball, time[moment[0]]) for ball in open_balls])
            distance = np.linalg.norm(expected[:, :, None] - position[None][:, :, moment], axis=1)
            for row, column in zip(*linear_sum_assignment(distance), strict=True):
                if distance[row, column] < REACH:
                    open_balls[row].append(int(moment[column]))
                    left.discard(int(moment[column]))
        balls += [[i] for i in sorted(left)]
    for ball in balls:
        yield time[ball], position[:, ball]


def _extrapolate(time: np.ndarray, position: np.ndarray, ball: list[int], at: float) -> np.ndarray:
    """Where a ball that goes on as it did is at a time."""
    last, before = ball[-1], ball[max(len(ball) - 4, 0)]
    if last == before:
        return position[:, last]
    velocity = (position[:, last] - position[:, before]) / (time[last] - time[before])
    return position[:, last] + velocity * (at - time[last])


def _part_silences(time: Float[np.ndarray, " n"], position: Float[np.ndarray, "3 n"]) -> Iterator[Track]:
    """The pieces of a track that is longer than one flight, parted where its ball was unseen."""
    steps = np.diff(time)
    cuts = np.zeros(0, int)
    if time[-1] - time[0] > ONE_FLIGHT:
        cuts = np.flatnonzero(steps > max(SILENCE, SILENT_SAMPLES * float(np.median(steps)))) + 1
    yield from zip(np.split(time, cuts), np.split(position, cuts, axis=1), strict=True)
