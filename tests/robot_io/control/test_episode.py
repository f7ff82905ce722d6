"""Outcome of a ball from the tracker's samples, against the ball's true flight."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from robot_io.control.episode import HIT, MISSED, RETURNED, Episode
from robot_io.control.strokes import in_play
from robot_io.devices.ball_datagram import BallSample, encode
from robot_io.devices.tracker import Tracker, TrackerConfig
from robot_io.emulator.config import RigParams
from robot_io.emulator.network import NetworkFaults
from robot_io.emulator.tracker import TrackerParams
from tests.oracles import ball_flight
from tests.oracles.ball_flight import Touch
from tests.support.lockstep_play import lockstep, throws

BLADE, NORMAL = np.array([0.2, -1.5, 0.3]), np.array([0.0, 1.0, 0.0])
DT = 0.008


def flight(*touches: Touch, end: float = 0.4):
    """Positions (n, 3) every 8 ms of a ball that flies freely after each touch, the first one being its throw."""
    moments = np.arange(touches[0].time, touches[-1].time + end, DT)
    parts = []
    for touch, following in zip(touches, [*touches[1:], None], strict=True):
        until = np.inf if following is None else following.time
        part = moments[(moments >= touch.time) & (moments < until)]
        if part.size:
            parts.append(ball_flight.path(touch, np.concatenate([part, [part[-1] + 1e-6]]))[:, :-1].T)
    return np.concatenate(parts)


def followed(positions, noise=0.0, seed=0, lost=0.0, blade=BLADE):
    """The episode after all samples and then silence."""
    random, tracker, episode = np.random.default_rng(seed), Tracker(TrackerConfig()), None
    for i, position in enumerate(positions):
        if random.random() < lost:
            continue
        seen = position + noise * random.normal(size=3)
        now = i * DT + 0.015
        sample = tracker.receive(encode(BallSample(i, 1, i * DT, seen)), "127.0.0.1", now)
        if episode is None and in_play(tracker.track, tracker.seen, now):
            episode = Episode(1, 1, now)
        if episode is not None:
            episode.follow(sample, blade, now)
            episode.check(now, 200)
    assert episode is not None, "never in play"
    episode.check(len(positions) * DT + 1.0, 200)
    assert episode.decided
    return episode.summary()


def thrown(speed, up=0.0, bounces=True):
    return ball_flight.serve([0.2, 1.2, 0.5], -speed, BLADE, NORMAL, up, bounces)


def returned(at, landing, seconds):
    """A hit that lands at ``landing`` (2,) after ``seconds``; solved by shooting."""
    from scipy.optimize import fsolve

    target = np.array([*landing, 0.02])

    def miss(v):
        return (
            ball_flight.path(Touch(at.time, at.position, v, np.zeros(3)), [at.time, at.time + seconds])[:, -1] - target
        )

    v = fsolve(miss, (target - at.position) / seconds + [0, 0, 4.9 * seconds])
    return Touch(at.time, at.position, v, np.zeros(3))


def rally(landing, seconds=0.5, speed=6.0):
    serve = thrown(speed)
    bounce = ball_flight.on_table(serve)
    out = returned(ball_flight.on_blade(bounce, BLADE, NORMAL), landing, seconds)
    return serve, bounce, out, ball_flight.on_table(out)


@pytest.mark.parametrize("noise, lost", [(0.0, 0.0), (0.003, 0.0), (0.003, 0.1)])
@pytest.mark.parametrize("landing", [(0.3, 0.7), (-0.6, 1.33), (0.0, 0.25), (0.7, 1.0)])
def test_a_returned_ball(landing, noise, lost):
    touches = rally(landing)
    for seed in range(5):
        summary = followed(flight(*touches), noise, seed, lost)
        assert summary.outcome == RETURNED and summary.crossed
        np.testing.assert_allclose(summary.landing, landing, atol=0.02 if noise == 0 else 0.05)
        out = touches[2]
        over_net = ball_flight.fly(out, lambda p: -p[1])[1]
        assert summary.net_height == pytest.approx(over_net[2], abs=0.012)
        assert summary.closest < 0.15


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_balls_that_are_hit_and_do_not_return(noise):
    serve, bounce, out, _ = rally((0.3, 0.7))
    own = returned(out, (0.2, -0.5), 0.35)
    wide = returned(out, (1.1, 0.9), 0.5)
    wide_end = ball_flight.fly(wide, lambda p: p[2] + 0.5)[0] - wide.time
    long = returned(out, (0.2, 1.6), 0.5)
    net = returned(out, (0.2, 0.5), 0.3)  # through the net's height at y = 0 it is stopped
    at_net, state = ball_flight.fly(net, lambda p: -0.03 - p[1])
    stopped = Touch(at_net, state[:3], np.array([0.0, 0.2 * -state[4], 0.0]) * 0.3, np.zeros(3))
    for seed in range(5):
        back = followed(flight(serve, bounce, own, ball_flight.on_table(own)), noise, seed)
        assert back.outcome == HIT and not back.crossed
        np.testing.assert_allclose(back.landing, (0.2, -0.5), atol=0.05)
        aside = followed(flight(serve, bounce, wide, end=wide_end), noise, seed)
        assert aside.outcome == HIT and aside.crossed and aside.landing[0] > 0.9
        beyond = followed(flight(serve, bounce, long, end=0.6), noise, seed)
        assert beyond.outcome == HIT and beyond.crossed and beyond.landing[1] > 1.5
        caught = followed(flight(serve, bounce, net, stopped, ball_flight.on_table(stopped)), noise, seed)
        assert caught.outcome == HIT and not caught.crossed


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_balls_that_are_missed(noise):
    for seed in range(3):
        serve = thrown(6.0)
        past = followed(flight(serve, ball_flight.on_table(serve), end=0.7), noise, seed, blade=BLADE + [0.4, 0.0, 0.0])
        assert past.outcome == MISSED and past.closest == pytest.approx(0.4, abs=0.03)
        volley = thrown(8.0, bounces=False)
        contact = ball_flight.on_blade(volley, BLADE, NORMAL)
        out = returned(contact, (0.3, 0.7), 0.5)
        assert followed(flight(volley, out, ball_flight.on_table(out)), noise, seed).outcome == MISSED
        lob = Touch(0.0, np.array([0.2, 1.0, 0.4]), np.array([0.0, -2.4, 2.2]), np.zeros(3))
        first = ball_flight.on_table(lob)
        second = ball_flight.on_table(first)
        assert first.position[1] < 0 and second.position[1] > -1.37
        late = returned(
            Touch(
                second.time + 0.15,
                *ball_flight.path(second, [second.time, second.time + 0.15])[:, -1:].T,
                np.zeros(3),
                np.zeros(3),
            ),
            (0.3, 0.7),
            0.5,
        )
        twice = flight(lob, first, second, late, ball_flight.on_table(late))
        assert followed(twice, noise, seed, blade=late.position).outcome == MISSED
        short = Touch(0.0, np.array([0.2, 1.2, 0.4]), np.array([0.0, -3.0, -1.5]), np.zeros(3))
        human = ball_flight.on_table(short)
        assert human.position[1] > 0
        assert followed(flight(short, human, end=0.5), noise, seed).outcome == MISSED
        side = Touch(0.0, np.array([0.6, 1.2, 0.4]), np.array([2.5, -4.0, 1.0]), np.zeros(3))
        assert followed(flight(side, end=0.9), noise, seed).outcome == MISSED


def test_the_policy_is_taken_off_as_soon_as_the_ball_is_hit_or_lost():
    serve, bounce, out, last = rally((0.3, 0.7))
    positions, episode, tracker = flight(serve, bounce, out, last), None, Tracker(TrackerConfig())
    for i, position in enumerate(positions):
        sample = tracker.receive(encode(BallSample(i, 1, i * DT, position)), "127.0.0.1", i * DT)
        if episode is None and in_play(tracker.track, tracker.seen, i * DT):
            episode = Episode(1, 1, i * DT)
            assert i <= 3  # three samples tell a velocity
        elif episode is not None:
            episode.follow(sample, BLADE, i * DT)
            if episode.over:
                break
    assert out.time <= i * DT < out.time + 3 * DT


def test_an_episode_ends_by_itself():
    unseen = Episode(1, 1, 10.0)
    unseen.check(10.2, 200)
    assert not unseen.over
    unseen.check(10.3, 200)
    assert unseen.decided and unseen.summary().outcome == MISSED
    long = Episode(1, 1, 10.0, steps=200)
    long.check(10.1, 200)
    assert long.over and not long.decided
    other = Episode(1, 1, 10.0)
    other.follow(BallSample(5, 2, 10.1, np.zeros(3)), BLADE, 10.1)
    assert other.decided
    aborted = Episode(1, 1, 10.0)
    aborted.abort("estop", 10.1)
    aborted.abort("later", 10.2)
    assert aborted.summary().fault == "estop" and aborted.summary().ended == 10.1


def test_only_balls_that_come_are_in_play():
    def seen(velocity, start=(0.2, 1.2, 0.4), n=6, gap=0.0):
        tracker = Tracker(TrackerConfig())
        for i in range(n):
            position = np.array(start) + np.array(velocity) * i * DT
            tracker.receive(encode(BallSample(i, 1, i * DT, position)), "127.0.0.1", i * DT)
        return in_play(tracker.track, tracker.seen, (n - 1) * DT + gap)

    assert seen([0, -3, 0]) and not seen([0, 3, 0]) and not seen([0, -0.9, 0]) and not seen([0, -3, 0], n=2)
    assert not seen([0, -3, 0], start=(0.2, -0.3, 0.4)) and not seen([0, -3, 0], start=(0.2, 1.2, -0.4))
    assert seen([0, -3, 0], gap=0.059) and not seen([0, -3, 0], gap=0.061)
    assert not in_play(Tracker(TrackerConfig()).track, None, 0.0)


def truth(touches):
    """The outcome by the world's own touches, with the simulator's meaning."""
    bounced = hit = False
    for _, name, position in touches:
        if hit:
            if name == "col_table":
                return RETURNED if position[1] > 0 else HIT
        elif name == "rig_paddle" and bounced:
            hit = True
        elif name == "col_table" and not bounced and position[1] < 0:
            bounced = True
        else:
            return MISSED
    return HIT if hit else MISSED


@pytest.mark.parametrize("lost", [pytest.param(0.0, marks=pytest.mark.slow), 0.1])
def test_outcomes_agree_with_the_world_in_lock_step(lost):
    """40 balls at a paddle that stands in the way of some of them, 3 mm of noise."""
    network = NetworkFaults(loss=lost, duplication=lost, reordering=lost)
    params = RigParams(pause=0.02, tracker=TrackerParams(noise=0.003), tracker_network=network)
    n = 36 if lost == 0 else 8
    rig = lockstep(balls=throws(seed=3), params=params)
    rig.start()
    touches, found, rig.throwing = {}, [], True
    while len(found) < n and rig.now < 120:
        rig.step()
        touches[rig.world.number] = list(rig.world.touches)
        while rig.summaries:
            found.append(rig.summaries.popleft())
            if rig.world.number == found[-1].ball:
                rig.world.park()  # nothing more to be learnt
    wrong = [(s.outcome, truth(touches[s.ball]), touches[s.ball]) for s in found if s.outcome != truth(touches[s.ball])]
    assert len(found) == n and len(wrong) <= n // 20, wrong
    counts = Counter(truth(touches[s.ball]) for s in found)
    assert lost or (counts[MISSED] >= 5 and counts[HIT] + counts[RETURNED] >= 5), counts
    for summary in found:
        landing = [p for _, name, p in touches[summary.ball] if name == "col_table"][1:2]
        if summary.outcome == RETURNED and landing:
            np.testing.assert_allclose(summary.landing, landing[0][:2], atol=0.06)
