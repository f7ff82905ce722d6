"""A carriage runs against something in mid-swing; later that is taken away. The drive must not have waited to jump.

Under both ways in which a drive may drop a task (``DriveParams.holds_measured``), as stiff as a servo, with its own
following error watched or not.
"""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from robot_io.control.bridge import BridgeState
from robot_io.emulator.arm import ArmParams
from robot_io.emulator.config import RigParams
from robot_io.errors import JogFirstError
from robot_io.limits import LIMITS
from tests.support.lockstep_play import Swing, Wild, playing

JUMP = 0.005  # [m]


def blocked(axis, holds_measured, stop, policy=None, share=0.7, gain=20.0, limit=1.0):
    """The state after 2 s against the obstacle, the drive's set-point beyond it [m], and how far it then goes on [m].

    stop: None waits for the fault, else the operator stops [s] later; limit: of the drive's own following error [m].
    share: of the fastest swing of that axis. None: it was never that fast, its drive had switched off, or it came
    away from the obstacle by itself and the robot plays on.
    """
    params = RigParams(pause=0.05, arm=ArmParams(comm_timeout=0.1))
    drive = replace(params.drive, position_gain=gain, following_error=limit, holds_measured=holds_measured)
    rig = playing(policy or Swing(1.0), params=replace(params, drive=drive))
    world, bridge, speed = rig.world, rig.bridge, share * (1.2, 0.5)[axis]
    if not rig.run(5.0, lambda: bridge.state is BridgeState.ACTIVE and abs(world.qvel[axis]) > speed):
        return None
    wall, side, obstacle, advance = world.qpos[axis], np.sign(world.qvel[axis]), True, world.advance

    def stopped_by_the_wall(setpoint, duration):
        advance(setpoint, duration)
        if obstacle and (world.qpos[axis] - wall) * side > 0.0:
            world.data.qpos[world._q[axis]], world.data.qvel[world._v[axis]] = wall, 0.0
            mujoco.mj_forward(world.model, world.data)

    world.advance = stopped_by_the_wall
    try:
        if stop is not None:
            rig.run(stop)
            bridge.stop(rig.now)
        rig.run(2.0)
        state, push = bridge.state, (rig.emulators[axis].drive.x - wall) * side
        if not rig.emulators[axis].drive.operating or state not in (BridgeState.FAULT, BridgeState.DISARMED):
            return None
        freed, obstacle = world.qpos[axis], False
        farthest = [0.0]

        def look():
            farthest[0] = max(farthest[0], (world.qpos[axis] - freed) * side)
            return False

        rig.run(1.0, look)
    finally:
        del world.advance
    return state, push, farthest[0]


@pytest.mark.parametrize("holds_measured", [False, True])
@pytest.mark.parametrize(("axis", "stop"), [(0, None), (1, None), (0, 0.03), (1, 0.03)])
def test_a_blocked_carriage_is_neither_pushed_nor_jumps_when_it_is_free(axis, stop, holds_measured):
    state, push, jump = blocked(axis, holds_measured, stop)
    assert state is BridgeState.FAULT or stop is not None
    assert push < JUMP and jump < JUMP


def test_an_axis_outside_its_range_is_pushed_back_by_hand_before_the_robot_is_armed():
    rig = playing(Swing(0.5))
    rig.throwing = False
    rig.bridge.stop(rig.now)
    rig.run(2.0, lambda: rig.bridge.state is BridgeState.DISARMED)
    rig.axes.disable()
    rig.run(0.5)
    rig.world.hold(1, LIMITS.upper[1] - 0.001)
    rig.axes.enable()
    rig.run(1.0)
    with pytest.raises(JogFirstError, match="gantry_y is at .* by hand without power"):
        rig.bridge.arm(rig.now)
    rig.recover()
    assert rig.bridge.state is BridgeState.READY and not rig.bridge.gate.faults
    before = rig.world.qpos
    rig.run(1.0)
    assert abs(rig.world.qpos - before).max() < JUMP  # nor does its drive go back to where it was


@pytest.mark.slow
def test_a_hundred_blocked_carriages():
    random, done = np.random.default_rng(0), 0
    for number in range(400):
        stop = None if random.random() < 0.5 else random.uniform(0.0, 0.2)
        policy = Swing(random.uniform(0.5, 1.0)) if number % 2 else Wild(number)
        gain, limit = random.choice([10.0, 20.0, 50.0]), random.choice([0.1, 0.15, 1.0])
        options = dict(policy=policy, share=random.uniform(0.2, 1.2), gain=gain, limit=limit)
        found = blocked(number % 2, bool(number // 2 % 2), stop, **options)
        if found is None:
            continue
        assert found[1] < JUMP and found[2] < JUMP, (number, stop, options, found)
        done += 1
        if done == 100:
            return
    raise AssertionError(f"only {done} carriages were blocked under power")
