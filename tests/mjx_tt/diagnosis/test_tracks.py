"""Dirt of eleven kinds, made from flights of the examination's physics, is cleaned or named by trajectory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.tracks import clean
from mjx_tt.diagnosis.tracks.frame import align
from tests.exam.generator.sessions import draw_balls, measure
from tests.exam.generator.world import World, fly

SIGMA = 0.003  # [m]
DT = 1 / 125
WORLD = World()


@cache
def flights(n: int = 24, seed: int = 0, noise: str = "iid", world: World = WORLD) -> tuple[Trajectory, ...]:
    """Strokes of people and returns, one bounce each, with 3 mm of noise."""
    rng = np.random.default_rng(seed)
    log = measure(world, draw_balls(rng, n), noise, rng)
    out = []
    for i in range(n):
        seen = np.isfinite(log.position[0, :, i])
        out.append(Trajectory(f"s{log.session[i]}", f"{i}", log.time[seen, i], log.position[:, seen, i]))
    return tuple(out)


@dataclass
class Dirty:
    """A dirtied log: the tracks, what was done to which, and the strokes that should come out."""

    tracks: list[Trajectory]
    touched: set[str]
    strokes: list[Trajectory]
    kind: str


def _with(t: Trajectory, position=None, time=None, name=None) -> Trajectory:
    return Trajectory(
        t.session, name or t.name, t.time if time is None else time, t.position if position is None else position
    )


def outliers(rng) -> Dirty:
    tracks, touched, strokes = [], set(), []
    for t in flights():
        wild = rng.random(len(t)) < 0.05
        p = t.position.copy()
        direction = rng.standard_normal((3, len(t)))
        p += wild * direction / np.linalg.norm(direction, axis=0) * rng.uniform(0.08, 1.0, len(t))
        tracks.append(_with(t, p))
        strokes.append(_with(t, t.position[:, ~wild], t.time[~wild]))
        touched |= {t.label} if wild.any() else set()
    return Dirty(tracks, touched, strokes, "outlier")


def repeats(rng) -> Dirty:
    tracks, touched, strokes = list(flights()), set(), list(flights())
    for i in range(0, 24, 4):
        t, k = tracks[i], int(rng.integers(8, 20))
        p = t.position.copy()
        p[:, k : k + 4] = p[:, k - 1 : k]
        tracks[i] = _with(t, p)
        keep = np.r_[0:k, k + 4 : len(t)]
        strokes[i] = _with(t, t.position[:, keep], t.time[keep])
        touched.add(t.label)
    return Dirty(tracks, touched, strokes, "repeat")


def swapped_ids(rng) -> Dirty:
    """Two balls in the air at once exchange their ids at some sample."""
    tracks, touched = list(flights()), set()
    strokes = []
    for i in range(0, 12, 2):
        a, b = tracks[i], tracks[i + 1]
        n = min(len(a), len(b))
        time = 100.0 * i + np.arange(n) * DT
        k = int(rng.integers(15, n - 15))
        session = "swapped"
        pa, pb = a.position[:, :n], b.position[:, :n]
        strokes += [Trajectory(session, a.name, time, pa), Trajectory(session, b.name, time, pb)]
        tracks[i] = Trajectory(session, a.name, time, np.concatenate([pa[:, :k], pb[:, k:]], axis=1))
        tracks[i + 1] = Trajectory(session, b.name, time, np.concatenate([pb[:, :k], pa[:, k:]], axis=1))
        touched |= {tracks[i].label, tracks[i + 1].label}
    return Dirty(tracks, touched, strokes + tracks[12:], "swap|rally")


def id_jumps(rng) -> Dirty:
    """An id that goes on to the next ball."""
    tracks, touched, strokes = [], set(), []
    for i, t in enumerate(flights()):
        if i % 4 == 0:
            other = flights()[i + 1]
            later = t.time[-1] + DT + other.time - other.time[0]
            joined = Trajectory(t.session, t.name, np.r_[t.time, later], np.c_[t.position, other.position])
            tracks.append(joined)
            strokes += [t, _with(other, time=later, name=f"{t.name}/2")]
            touched.add(t.label)
        elif i % 4 != 1:
            tracks.append(t)
            strokes.append(t)
    return Dirty(tracks, touched, strokes, "jump")


def two_at_once(rng) -> Dirty:
    """An id whose samples alternate between two balls."""
    tracks, touched, strokes = [], set(), []
    for i, t in enumerate(flights()):
        if i % 4 == 0:
            other = flights()[i + 1]
            start = t.time[0] + 0.5 * DT
            time = np.r_[t.time, start + other.time - other.time[0]]
            order = np.argsort(time)
            tracks.append(Trajectory(t.session, t.name, time[order], np.c_[t.position, other.position][:, order]))
            strokes += [t, _with(other, time=start + other.time - other.time[0], name=f"{t.name}/2")]
            touched.add(t.label)
        elif i % 4 != 1:
            tracks.append(t)
            strokes.append(t)
    return Dirty(tracks, touched, strokes, "two balls")


def _played_on(t: Trajectory, until: float, rng) -> tuple[np.ndarray, np.ndarray]:
    """Times and positions of what follows a racket at the track's end, back over the net."""
    x0, towards = t.position[:, -1], -np.sign(t.position[1, -1] - t.position[1, 0])
    time = np.arange(1, int(until / DT)) * DT
    v0 = np.array([0.2, towards * 5.0, 2.0])
    p = x0[:, None] + v0[:, None] * time - 0.5 * 9.81 * np.array([[0], [0], [1]]) * time**2
    return t.time[-1] + time, p + SIGMA * rng.standard_normal(p.shape)


def rallies(rng) -> Dirty:
    tracks, touched, strokes = [], set(), []
    for t in flights():
        later, p = _played_on(t, 0.3, rng)
        tracks.append(Trajectory(t.session, t.name, np.r_[t.time, later], np.c_[t.position, p]))
        strokes += [t, Trajectory(t.session, f"{t.name}/2", later, p)]
        touched.add(t.label)
    return Dirty(tracks, touched, strokes, "rally")


def on_the_floor(rng) -> Dirty:
    """Missed balls that fly on past the table's end to the floor and bounce there."""
    tracks, touched, strokes = [], set(), []
    flight = fly(WORLD, draw_balls(np.random.default_rng(0), 24).start, 1.65)
    ended = np.where(np.isfinite(flight.end_time), flight.end_time, 0.0)
    beyond = np.abs(flight.at(ended[None] - 1e-6)[1, 0]) > 1.40
    flight = replace(flight, end_time=np.full(24, np.inf))  # what the generator's table does not end, the real one does
    time = np.repeat(np.arange(200)[:, None] * DT, 24, axis=1)
    for i, (t, p) in enumerate(zip(flights(), np.moveaxis(flight.at(time), 2, 0), strict=True)):
        k = int(np.argmax(p[2] < -0.74))
        if not beyond[i] or not 0 < k < 165:
            tracks.append(t)
            strokes.append(t)
            continue
        v = (p[:, k - 1] - p[:, k - 2]) / DT * [1.0, 1.0, -0.8]
        after = np.arange(30) * DT
        p[:, k : k + 30] = (p[:, k - 1] + v * after[:, None] - np.outer(4.905 * after**2, [0, 0, 1])).T
        p = p[:, : k + 30] + SIGMA * rng.standard_normal((3, k + 30))
        stamps = t.time[0] + np.arange(k + 30) * DT
        tracks.append(Trajectory(t.session, t.name, stamps, p))
        strokes.append(Trajectory(t.session, t.name, stamps[:k], p[:, :k]))
        touched.add(t.label)
    assert len(touched) > 6
    return Dirty(tracks, touched, strokes, "floor")


def in_the_hand(rng) -> Dirty:
    """A ball held before the stroke, and carried a little."""
    tracks, touched, strokes = list(flights()), set(), list(flights())
    for i in range(0, 24, 2):
        t = tracks[i]
        time = np.arange(-60, 0) * DT
        hand = t.position[:, :1] + np.array([[0.1], [0.0], [0.1]]) * time + SIGMA * rng.standard_normal((3, 60))
        tracks[i] = Trajectory(t.session, t.name, np.r_[t.time[0] + time, t.time], np.c_[hand, t.position])
        touched.add(t.label)
    return Dirty(tracks, touched, strokes, "rally|racket|not in flight")


def at_the_net(rng) -> Dirty:
    """Low balls that touch the cord and drop behind the net."""
    tracks, touched, strokes = list(flights()), set(), list(flights())
    for i, t in enumerate(flights()):
        k = int(np.argmax(np.sign(t.position[1]) != np.sign(t.position[1, 0])))
        if t.position[2, k] > 0.21:
            continue
        at = t.position[:, k]
        time = np.arange(1, 20) * DT
        v = (at - t.position[:, k - 8]) / (8 * DT) * [1.0, 0.1, 0.0]
        p = at[:, None] + v[:, None] * time - 4.905 * np.array([[0], [0], [1]]) * time**2
        p += SIGMA * rng.standard_normal(p.shape)
        stamps = t.time[k] + time
        tracks[i] = Trajectory(t.session, t.name, np.r_[t.time[: k + 1], stamps], np.c_[t.position[:, : k + 1], p])
        strokes[i] = t.part(0, k + 1)
        touched.add(t.label)
    assert len(touched) > 2
    return Dirty(tracks, touched, strokes, "net")


def dropouts(rng) -> Dirty:
    """A fifth of the samples and a tenth of a second gone: nothing to clean, and nothing is cut."""
    tracks = []
    for t in flights():
        keep = rng.random(len(t)) > 0.2
        k = int(rng.integers(10, len(t) - 25))
        keep[k : k + 12] = False
        tracks.append(_with(t, t.position[:, keep], t.time[keep]))
    return Dirty(tracks, set(), list(tracks), "nothing")


def fragments(rng) -> Dirty:
    tracks, touched, strokes = list(flights()), set(), []
    for i, t in enumerate(flights()):
        if i % 3 == 0:
            later, p = _played_on(t, 6.5 * DT, rng)
            tracks[i] = Trajectory(t.session, t.name, np.r_[t.time, later], np.c_[t.position, p])
            touched.add(t.label)
        strokes.append(t)
    return Dirty(tracks, touched, strokes, "fragment|outlier")


KINDS = (
    outliers,
    repeats,
    swapped_ids,
    id_jumps,
    two_at_once,
    rallies,
    on_the_floor,
    in_the_hand,
    at_the_net,
    dropouts,
    fragments,
)


def shares(found: tuple[Trajectory, ...], wanted: list[Trajectory]) -> tuple[float, float, float]:
    """Shares of the wanted strokes that came out whole, of their samples that did, and of foreign samples among all."""

    def rows(t: Trajectory) -> set[bytes]:
        return {row.tobytes() for row in np.ascontiguousarray(t.position.T)}

    pieces = [rows(t) for t in found]
    whole, kept, total = 0, 0, 0
    for t in wanted:
        mine = rows(t)
        best = max((len(mine & other) for other in pieces), default=0)
        whole += best >= 0.93 * len(mine)
        kept, total = kept + best, total + len(mine)
    good = set().union(*map(rows, wanted))
    out = [row for piece in pieces for row in piece]
    return whole / len(wanted), kept / total, sum(row not in good for row in out) / max(len(out), 1)


@pytest.mark.parametrize("dirt", KINDS, ids=lambda d: d.__name__)
def test_dirt_is_cleaned_and_named(dirt):
    made = dirt(np.random.default_rng(1))
    strokes, record = clean(made.tracks)
    whole, kept, foreign = shares(strokes, made.strokes)
    # Two balls within a hand's width of each other cannot be told apart there.
    near = dirt in (two_at_once, swapped_ids)
    assert whole >= (0.9 if near else 0.95) and kept >= 0.94 and foreign <= 0.01
    named = {e.trajectory for kind in made.kind.split("|") for e in record.of(kind)}
    assert len(made.touched & named) >= 0.95 * len(made.touched)
    assert not set(record.labels) - made.touched
    assert all(name.split("/")[-1] in " ".join(record.lines(99)) for name in made.touched)


@pytest.mark.parametrize("noise", ["iid", "ar1", "causal"])
def test_a_clean_log_stays_what_it_is(noise):
    balls = flights(120, 3, noise)
    strokes, record = clean(balls)
    assert all(a is b for a, b in zip(strokes, balls, strict=True)) and not record.entries
    assert record.tracks == strokes


def test_rallies_are_left_out_where_spin_is_not_known():
    made = rallies(np.random.default_rng(1))
    strokes, record = clean(made.tracks, rallies=False)
    assert len(strokes) == 24 and len(record.of("racket")) == 24
    assert [len(t) for t in record.tracks] == [len(t) for t in made.tracks]  # the hits and their returns, whole


def test_stamps_that_shake_past_each_other_in_a_held_ball():
    """An arc that takes over from another may hold a sample of the same moment; once that was an IndexError."""
    rng, shaken = np.random.default_rng(21), []
    for t in in_the_hand(rng).tracks:
        stamp = t.time + 0.005 * rng.standard_normal(len(t))
        order = np.argsort(stamp)
        shaken.append(_with(t, t.position[:, order], stamp[order]))
    strokes, record = clean(shaken)
    assert all(np.all(np.diff(t.time) > 0.0) for t in strokes)
    assert {e.kind for e in record.entries} >= {"not in flight"}


def test_fast_balls_are_no_swapped_axes():
    """At 11 m/s drag is 17 m/s^2."""
    time = np.arange(40) / 180
    out = []
    for i in range(8):
        v, p = np.array([0.2 * i - 0.8, -11.0, 1.0]), np.array([0.0, 1.3, 0.3])
        path = []
        for _ in time:
            path.append(p)
            a = -0.141 * np.linalg.norm(v) * v - [0, 0, 9.81]
            p, v = p + v / 180 + a / 2 / 180**2, v + a / 180
        out.append(Trajectory("fast", f"{i}", time, np.array(path).T))
    aligned, notes = align(out, "log.csv")
    assert aligned == tuple(out) and not notes


@pytest.mark.parametrize(
    "shift, turn, words",
    [
        ((0.7625, 1.37, 0.76), 0, "corner+floor"),
        ((0.0, 1.37, 0.0), 0, "end"),
        ((0.7625, -1.37, 0.0), 1, "corner+x-along"),
    ],
)
def test_another_frame_is_found_and_said(shift, turn, words):
    quarter = np.linalg.matrix_power(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), turn)
    balls = flights()
    moved = [_with(t, quarter @ (t.position + np.array(shift)[:, None])) for t in balls]
    for told in (None, words):
        aligned, notes = align(moved, "log.csv", told)
        assert len(notes) == 1 and words.replace("+", ", ") in notes[0]
        for found, ball in zip(aligned, balls, strict=True):
            np.testing.assert_allclose(found.position, ball.position, atol=1e-12)
