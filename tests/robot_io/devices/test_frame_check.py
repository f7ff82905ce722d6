"""Frames and clocks of trackers, against balls of MuJoCo's world: what is wrong must not be armed, and is named."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot_io.devices.ball_datagram import BallSample
from robot_io.devices.frame_check import NEEDED, FrameCheck
from robot_io.devices.tracker import TrackerConfig
from robot_io.emulator.config import RigParams
from robot_io.emulator.hidden import HiddenErrors
from robot_io.emulator.tracker import TrackerParams
from robot_io.errors import RefusedError
from robot_io.limits import LIMITS
from tests.support.lockstep_play import lockstep, playing

QUARTER = math.pi / 2


def rig(hidden, **options):
    return lockstep(params=RigParams(pause=0.05, hidden=hidden), balls_needed=NEEDED, **options)


@pytest.mark.parametrize(
    ("hidden", "named"),
    [
        ({"camera_position": (0.0, 0.0, -0.76)}, "measured from the floor"),
        ({"camera_position": (0.0, 0.0, 0.1)}, r"-0\.\d+ m from where a ball on the table is"),
        ({"camera_position": (0.0, 0.0, -0.1)}, r"\+0\.\d+ m from where a ball on the table is"),
        ({"camera_angles": (0.0, 0.0, QUARTER)}, "turned by 90 degrees"),
        ({"camera_angles": (0.0, 0.0, -QUARTER)}, "turned by 90 degrees"),
        ({"camera_angles": (0.0, 0.0, math.pi)}, "turned by 180 degrees"),
        ({"camera_scale": (1.0, -1.0, 1.0)}, "y mirrored"),
        ({"camera_angles": (QUARTER, 0.0, 0.0)}, "swapped axes"),
        ({"camera_scale": (1.0, 1.0, -1.0)}, "z must point up"),
        ({"camera_scale": (1000.0,) * 3}, "millimetres"),
        ({"camera_scale": (3.28,) * 3}, "not the table's"),
        ({"camera_position": (-0.7625, -1.37, 0.0)}, "beside the table"),
        ({"clock_offset": 0.1}, "clock_offset is not theirs"),
        ({"clock_offset": -100.0}, "clock_offset is not theirs"),
        ({"clock_offset": -0.03}, "clock is off by"),
        ({"clock_drift": -0.006}, r"-\d+ ppm"),
    ],
)
def test_a_wrong_frame_or_clock_is_not_armed_and_named(hidden, named):
    wrong = rig(HiddenErrors(**hidden))
    with pytest.raises(RefusedError, match=f"not armed: .*{named}"):
        wrong.start()
    assert not wrong.bridge.gate.engaged and np.abs(wrong.world.qvel).max() < 1e-9


@pytest.mark.parametrize("noise", [0.0, 0.003])
@pytest.mark.parametrize(
    "hidden", [{}, {"camera_position": (0.02, -0.02, 0.02)}, {"clock_offset": 1e4}], ids=["exact", "near", "clock"]
)
def test_a_right_frame_is_shown_by_three_balls(hidden, noise):
    params = RigParams(pause=0.05, hidden=HiddenErrors(**hidden), tracker=TrackerParams(noise=noise))
    config = TrackerConfig(clock_offset=None if hidden.get("clock_offset") else 0.0)
    right = lockstep(params=params, balls_needed=NEEDED, tracker=config)
    right.run(0.5)
    assert "0 of 3 balls" in right.bridge.frame_check.wanted
    right.start()
    assert right.bridge.at_home and right.thrower.thrown <= NEEDED + 2


def test_a_clock_that_runs_a_little_fast_is_told_within_ten_seconds():
    """Sooner, jitter of the network cannot be told from it."""
    fast = rig(HiddenErrors(clock_drift=9e-4))
    fast.start()
    assert fast.run(10.0, lambda: bool(fast.bridge.gate.faults))
    assert fast.bridge.gate.faults[0].cause.value == "clock"


def test_x_mirrored_leaves_no_sign():
    """What bounces cannot tell, and a ball held by hand must."""
    rig(HiddenErrors(camera_scale=(-1.0, 1.0, 1.0))).start()


def test_a_tracker_that_is_moved_in_a_session_stops_the_robot():
    moved = playing()
    bridge = moved.bridge
    moved.run(6.0)
    assert not bridge.gate.faults
    moved.cameras._hidden = HiddenErrors(camera_position=(0.0, 0.0, -0.15))
    speeds = []
    assert moved.run(20.0, lambda: speeds.append(moved.world.qvel) or bool(bridge.gate.faults))
    assert bridge.gate.faults[0].cause.value == "tracker_frame"
    before = bridge.gate.velocity
    moved.run(0.5)
    assert (np.abs(bridge.gate.velocity) <= np.abs(before)).all() and np.abs(moved.world.qvel).max() < 0.05
    assert (np.abs(np.diff(np.array(speeds), axis=0)) <= 1.2 * np.array(LIMITS.velocity)).all()
    with pytest.raises(RefusedError, match="not armed"):
        bridge.arm(moved.now)


def test_a_ball_that_is_carried_or_rests_is_no_sign():
    check, random = FrameCheck(), np.random.default_rng(0)
    for i in range(3000):
        t = 0.008 * i
        place = np.array([0.3 * math.sin(t), -0.5 + 0.4 * math.cos(0.7 * t), 0.3 + 0.2 * math.sin(1.3 * t)])
        check.add(BallSample(i, 1, t, place + 0.003 * random.normal(size=3)))
    assert check.problem is None and check.shown == 0
