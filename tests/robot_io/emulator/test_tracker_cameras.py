"""Two cameras of the rig: noise as pixels make it, what is lost, and what the bridge's own reader makes of all that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from experiments.config import robot as robots
from experiments.errors import ConfigError
from robot_io.devices.tracker import Tracker, TrackerConfig
from robot_io.emulator.config import RigParams
from robot_io.emulator.tracker import CameraPair, CameraParams, TrackerEmulator, TrackerParams
from tests.support.lockstep_play import lockstep

PAIR = CameraParams(triangulated=True)


def seen(params, ball, frames=4000, number=1):
    pair = CameraPair(params, 125.0, np.random.default_rng(0))
    return [pair.see(number, np.asarray(ball, float)) for _ in range(frames)]


@pytest.mark.parametrize(
    "wrong, named",
    [
        ({"first": [0, 0, 2.2]}, "tracker.cameras.first: expected .* beside .*, got (0.0, 0.0, 2.2)"),
        ({"second": [0.05, 0, 3]}, "tracker.cameras.second: expected .* beside .*, got (0.05, 0.0, 3.0)"),
        ({"first": [2.6, -1.6, 2.15]}, "tracker.cameras.second: expected .* away from first, got"),
    ],
)
def test_cameras_that_cannot_triangulate_are_refused(wrong, named):
    with pytest.raises(ConfigError, match=named.replace("(", "[(]").replace(")", "[)]")):
        robots.fill(RigParams, {"tracker": {"cameras": {"triangulated": True, **wrong}}}, "rig.yaml")


def test_noise_is_that_of_pixels_in_each_direction():
    """Against the inverse of the information that both images give, by numerical derivatives of the projection."""
    ball = np.array([0.3, -0.6, 0.4])
    places = np.array([place for _, place in seen(PAIR, ball)])
    information = np.zeros((3, 3))
    for centre in (PAIR.first, PAIR.second):
        ray = ball - centre
        depth = ray @ (-np.array(centre)) / np.linalg.norm(centre)
        unit = ray / np.linalg.norm(ray)
        information += (PAIR.focal / depth / PAIR.pixel_noise) ** 2 * (np.eye(3) - np.outer(unit, unit))
    expected = np.sqrt(np.diag(np.linalg.inv(information)))
    np.testing.assert_allclose(places.std(0), expected, rtol=0.15)
    np.testing.assert_allclose(places.mean(0), ball, atol=2e-4)
    assert 0.001 < expected.max() < 0.005


def test_drop_outs_false_sights_and_switches_come_as_often_as_asked():
    ball = [0.0, 0.5, 0.3]
    lost = [place is None for _, place in seen(replace(PAIR, drop_out=0.01, lost_for=0.08), ball)]
    assert 0.08 < np.mean(lost) < 0.25  # either of two cameras, 10 frames each time
    away = [
        np.linalg.norm(place - ball) > 0.05
        for _, place in seen(replace(PAIR, false_sight=0.02), ball)
        if place is not None
    ]
    assert np.mean(away) == pytest.approx(0.04, rel=0.3)
    numbers = [number for number, _ in seen(replace(PAIR, switch=0.01), ball)]
    assert numbers[-1] - numbers[0] == pytest.approx(40, rel=0.4) and (np.diff(numbers) >= 0).all()
    assert {place is None for _, place in seen(PAIR, [0.0, 30.0, 0.3], 10)} == {True}  # out of the image
    forgetful = seen(replace(PAIR, drop_out=0.02, lost_for=0.4), ball)
    assert forgetful[-1][0] > 10  # a ball that was away for long has another number


def test_the_bridges_reader_refuses_false_sights_and_follows_switches():
    cameras = replace(PAIR, false_sight=0.02, switch=0.02, drop_out=0.005)
    emulator = TrackerEmulator(TrackerParams(cameras=cameras), 3)
    tracker, worst = Tracker(TrackerConfig()), []
    for i in range(2000):
        now, ball = i * 0.008, np.array([0.2, 1.2 - 0.01 * (i % 200), 0.3])
        emulator.step(now, i // 200, ball)
        for datagram in emulator.due(now + 0.015):
            sample = tracker.receive(datagram, "127.0.0.1", now + 0.015)
            if sample is not None and sample.position is not None:
                worst.append(np.linalg.norm(sample.position - ball))
    assert tracker.counts["outlier"] > 30 and len(worst) > 1500
    assert np.quantile(worst, 0.97) < 0.02


def test_balls_are_played_through_two_cameras():
    """A whole lock-step rig, whose tracker loses and renames the ball now and then."""
    cameras = replace(PAIR, drop_out=0.002, switch=0.005, false_sight=0.002)
    rig = lockstep(params=RigParams(pause=0.05, tracker=TrackerParams(cameras=cameras)))
    rig.start()
    assert len(rig.play(5)) == 5
    assert rig.bridge.tracker.counts["accepted"] > 200 and not rig.bridge.gate.faults
