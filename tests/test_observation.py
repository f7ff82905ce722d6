"""What the bridge shows the policy equals what the simulator shows it, when both see the same motion.

An episode is played in the simulator in float64. What happened at every substep goes to the bridge as bytes, the way
devices send it: tracker datagrams, EGM packets, Modbus registers. The fixed delays of the simulator are the bridge's.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from playing import P, episodes, model, play, script, task

from mjx_tt.model import LATENCIES
from robot_io.bridge import Bridge, BridgeConfig, State
from robot_io.contract import ABB_JOINTS, FESTO_JOINTS, N_JOINTS, N_OBSERVATION
from robot_io.egm import EgmConfig, EgmSession
from robot_io.egm_messages import encode_robot
from robot_io.festo import AxesConfig, Axis, CmmtProfile, DirectLink, FestoAxes
from robot_io.history import History
from robot_io.observation import Feedback, ObservationDelays, joints, observe
from robot_io.rig.axes import AxisEmulator
from robot_io.rig.axis_drive import DriveParams
from robot_io.rig.axis_registers import AxisUnits
from robot_io.safety import SafetyConfig, SafetyGate
from robot_io.tracker import BallSample, Tracker, TrackerConfig, encode

T, SUBSTEPS, TICKS = 1 / 75, 4, 100
H = T / SUBSTEPS
HOME, ADDRESS = "127.0.0.1", ("127.0.0.1", 6511)
START = 1000.0  # [s] of the bridge's clock at the episode's first tick
DELAYS = (  # of ball, arm, axes [s]
    {"ball": 0.040, "arm": 0.029, "axes": 0.033},  # the nominal ones
    {"ball": 0.0, "arm": 0.0, "axes": 0.0},
    {"ball": 0.0417, "arm": 0.0033, "axes": 0.0271},
    {"ball": 0.0123, "arm": 0.0467, "axes": 0.0081},
)
NAMES = dict(zip(("ball", "arm", "axes"), LATENCIES[:3]))
MICROMETRE, FINEST = 1e-6, 1e-9  # [m] a count of the axes' position: the set-up's usual one; 32 bits at 2.1 m


class Recording:
    """A policy that keeps what it is shown and asks for nothing."""

    def __init__(self):
        self.seen = []

    def reset(self):
        self.seen = []

    def step(self, observation):
        self.seen.append(observation.copy())
        return np.zeros(N_JOINTS)


@pytest.fixture(scope="module")
def played():
    """Motion (TICKS * SUBSTEPS + 1, 11) at the substeps and what the simulator shows (TICKS, 11) under each of DELAYS."""
    rng = np.random.default_rng(1)
    actions = np.repeat(rng.uniform(-0.12, 0.12, (TICKS // 5, N_JOINTS, 1)), 5, axis=0)
    actions[:15] = 0.0  # at home until the ball has been seen
    # Episode j of the first four sees the motion j + 1 substeps late: together they see every substep.
    late = {name: [H * (j + 1) for j in range(SUBSTEPS)] + [d[key] for d in DELAYS] for key, name in NAMES.items()}
    late = {name: np.array(seconds) for name, seconds in late.items()}
    late |= {name: np.full(P, seconds) for name, seconds in zip(LATENCIES[3:], (0.055, 0.065))}
    with jax.enable_x64(True):
        record = play(task(), episodes([0.3, 1.3, 0.5], [0.1, -4.5, 1.0], late, model()), script(actions), TICKS)
    seen = record.controller  # (TICKS, 11, P)
    assert seen.dtype == np.float64
    motion = np.zeros((TICKS * SUBSTEPS + 1 - SUBSTEPS, N_OBSERVATION))
    for n in range(TICKS):
        for j in range(SUBSTEPS):
            if n * SUBSTEPS - (j + 1) >= 0:
                motion[n * SUBSTEPS - (j + 1)] = seen[n, :, j]
    return motion[:-1], seen[:, :, SUBSTEPS:], record


def to_bridge(motion, delays, unit):
    """The motion as bytes through the bridge's own receivers; what its policy was shown and the tick of the first."""
    units = AxisUnits(position=unit)
    emulators = [AxisEmulator("cmmt", 0.0, 0.0, 10.0, DriveParams(), units) for _ in FESTO_JOINTS]
    # A drive reads zero where it was switched on.
    axes = FestoAxes(
        [
            Axis(name, DirectLink(emulator), CmmtProfile(position_unit=unit), -0.9, 0.9, zero=float(motion[0, 3 + i]))
            for i, (name, emulator) in enumerate(zip("xy", emulators))
        ],
        AxesConfig(),
    )
    session = EgmSession(EgmConfig(controller_address=HOME, timeout=0.1))
    loose = SafetyConfig(following_error=(9.0,) * N_JOINTS)  # the robot moves as it was recorded, not as it is told
    policy = Recording()
    config = BridgeConfig(delays=ObservationDelays(**delays))
    bridge = Bridge(session, axes, Tracker(TrackerConfig()), SafetyGate(config=loose), policy, config)

    def devices(i, ball):
        now, state = START + i * H, motion[max(i, 0)]
        for j, emulator in zip(FESTO_JOINTS, emulators):
            emulator.step(now, float(state[3 + j]), 0.0)
        position = state[[3 + j for j in ABB_JOINTS]]
        packet = encode_robot(i + 1000, round(now * 1000), position, position, True, True, True)
        assert session.receive(packet, ADDRESS, now)
        assert bridge.arm_received(now) is not None
        bridge.tracker_received(encode(BallSample(i + 1000, ball, now, state[:3] if ball else None)), HOME, now)
        axes.cycle(now)
        bridge.axes_received(axes.state.position, axes.state.received)
        if i % SUBSTEPS == 0:
            bridge.tick(now, now)

    for i in range(-600, 0):
        devices(i, 0)
        if i == -580:
            axes.enable()
        if i == -60:
            axes._channels[0].status, axes._channels[1].status  # noqa: B018
    return bridge, policy, devices, axes


def run(motion, delays, unit=FINEST):
    bridge, policy, devices, axes = to_bridge(motion, delays, unit)
    # Homing would move the drives' zero; their state is what counts here.
    axes.problem = lambda now: None
    devices(-600 + 600 - 0, 0) if False else None
    for name in ("_watch",):
        assert hasattr(bridge, name)
    bridge.tick(START - 1e-3, START - 1e-3)
    bridge.arm(START - 1e-3)
    first = None
    for i in range(len(motion)):
        devices(i, 1)
        if first is None and bridge.state is State.ACTIVE:
            first = i // SUBSTEPS
    return first, np.array(policy.seen), bridge
