"""Strokes from the ball's track: by its turn, by a gap, by a new number, and by nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from robot_io.control.strokes import Seen, Strokes
from robot_io.devices.ball_datagram import BallSample

DT = 0.008
START, CONTACT = np.array([0.2, -1.0, 0.25]), 0.52  # [m] of the robot's return, [s] of the human's contact


def path(time):
    """A return at 4 m/s, and the human's answer at 5 m/s."""
    drop = np.array([0.0, 0.0, 1.5 * time - 4.905 * time**2 if time < 0.3 else 0.1])
    if time < CONTACT:
        return START + np.array([0.0, 4.0 * time, 0.0]) + 0.2 * drop
    there = START + np.array([0.0, 4.0 * CONTACT, 0.0]) + 0.2 * drop
    return there + np.array([-0.3, -5.0, 1.0]) * (time - CONTACT)


def seen(numbers=lambda t: 1, hidden=lambda t: False, noise=0.0, seed=0, until=0.8):
    """Strokes found: (number of frames after the contact, Strokes) of each, and all that ``add`` said."""
    random, strokes, found, said = np.random.default_rng(seed), Strokes(), [], []
    for i in range(round(until / DT)):
        t = i * DT
        position = path(t) + noise * random.normal(size=3)
        if hidden(t):
            continue
        said.append(strokes.add(BallSample(i, numbers(t), t, position)))
        if said[-1] is Seen.STROKE:
            found.append((t, strokes.began, strokes.continued, len(strokes.track)))
    return found, said


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_the_same_stroke_whatever_the_tracker_numbers(noise):
    """By the turn of v_y; bit for bit alike with one number, with one per stroke and with identities that switch."""
    for seed in range(20):
        same, _ = seen(noise=noise, seed=seed)
        per_stroke, _ = seen(lambda t: 1 + (t >= CONTACT), noise=noise, seed=seed)
        switching, _ = seen(lambda t: round(t / 0.1), noise=noise, seed=seed)
        assert same == per_stroke == switching
        ((told, began, _, kept),) = same
        assert CONTACT < told < CONTACT + 4 * DT
        assert abs(began - CONTACT) < 1.5 * DT and kept == 3  # history: what came since the stroke


def test_a_ball_that_was_lost_is_struck_once():
    """Out of sight from its bounce to the stroke; or while it comes, after which it is no new stroke."""
    lost, _ = seen(hidden=lambda t: 0.3 < t < CONTACT)
    assert len(lost) == 1 and lost[0][0] < CONTACT + 4 * DT
    renumbered, _ = seen(lambda t: 1 + (t > 0.4), hidden=lambda t: 0.3 < t < CONTACT)
    assert renumbered == lost
    coming, said = seen(lambda t: 1 + (t > 0.65), hidden=lambda t: CONTACT + 0.05 < t < CONTACT + 0.15)
    assert len(coming) == 1 and Seen.OTHER not in said[1:]


def test_another_ball_is_another_ball():
    strokes = Strokes()
    for i in range(6):
        strokes.add(BallSample(i, 1, i * DT, np.array([0.0, 1.0 - 0.03 * i, 0.3])))
    assert strokes.number == 1 and not strokes.continued
    found = [strokes.add(BallSample(i, 2, i * DT, np.array([0.4, 1.6 - 0.03 * i, 0.3]))) for i in range(6, 12)]
    assert found[0] is Seen.OTHER and found.count(Seen.STROKE) == 1 and not strokes.continued
    later = [strokes.add(BallSample(i, 2, i * DT, np.array([0.4, 1.6 - 0.03 * i, 0.3]))) for i in range(30, 36)]
    assert later[0] is Seen.SAME and Seen.STROKE not in later  # the same flight, after a gap
    again = [strokes.add(BallSample(i, 2, i * DT, np.array([0.4, 4.6 - 0.03 * i, 0.3]))) for i in range(60, 66)]
    assert again[0] is Seen.OTHER and again.count(Seen.STROKE) == 1  # back on the human's side


def test_what_is_no_stroke():
    def found(velocity, start, n=20):
        strokes = Strokes()
        for i in range(n):
            strokes.add(BallSample(i, 1, i * DT, np.array(start) + np.array(velocity) * i * DT))
        return strokes.number

    assert found([0, -3, 0], (0.2, 1.2, 0.4)) == 1
    assert not found([0, 3, 0], (0.2, -1.0, 0.4)) and not found([0, -0.9, 0], (0.2, 1.2, 0.4))
    assert not found([0, -3, 0], (0.2, -0.3, 0.4)) and not found([0, -3, 0], (0.2, 1.2, -0.4))
    net = Strokes()  # the robot's ball comes back from the net
    for i in range(30):
        y = -1.0 + 0.032 * i if i < 28 else -0.1 - 0.016 * (i - 28)
        net.add(BallSample(i, 1, i * DT, np.array([0.0, y, 0.1])))
    assert net.number == 0
