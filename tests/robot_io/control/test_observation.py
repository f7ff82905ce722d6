"""The bridge's observations equal the simulator's, when both see the same motion.

An episode is played in the simulator in float64. What happened at every substep goes to the bridge as bytes, the way
devices send it: tracker datagrams, EGM packets, Modbus registers. The fixed delays of the simulator are the bridge's.
"""

from __future__ import annotations

import jax
import numpy as np
import pytest

from mjx_tt.sim.model import LATENCIES
from robot_io.contract import ABB_JOINTS, FESTO_JOINTS, N_JOINTS, N_OBSERVATION
from robot_io.control.bridge import Bridge, BridgeConfig, BridgeState
from robot_io.control.observation import Feedback, ObservationDelays, joints, observe
from robot_io.devices.ball_datagram import BallSample, encode
from robot_io.devices.egm.arm_history import ArmHistory
from robot_io.devices.egm.messages import encode_robot
from robot_io.devices.egm.session import EgmConfig, EgmSession
from robot_io.devices.festo import AxesConfig, Axis, CmmtProfile, FestoAxes
from robot_io.devices.tracker import Tracker, TrackerConfig
from robot_io.emulator.axes import AxisEmulator
from robot_io.emulator.axis_drive import DriveParams
from robot_io.emulator.axis_registers import AxisUnits
from robot_io.history import History
from robot_io.safety.gate import SafetyConfig, SafetyGate
from tests.support.scripted_episodes import P, episodes, model, play, script, task

T, SUBSTEPS, TICKS = 1 / 75, 4, 100
H = T / SUBSTEPS
HOME, ADDRESS = "127.0.0.1", ("127.0.0.1", 6511)
START = 1000.0  # [s] of the bridge's clock at the episode's first tick
DELAYS = (  # of ball, arm, axes [s]
    {"ball": 0.040, "arm": 0.029, "axes": 0.033},  # the nominal ones
    {"ball": 1e-6, "arm": 1e-6, "axes": 1e-6},  # the simulator takes none for this
    {"ball": 0.0417, "arm": 0.0033, "axes": 0.0271},
    {"ball": 0.0123, "arm": 0.0467, "axes": 0.0081},
)
NAMES = dict(zip(("ball", "arm", "axes"), LATENCIES[:3], strict=True))
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
    """Motion (TICKS * SUBSTEPS + 1, 11) at the substeps; observations (TICKS, 11) under each of DELAYS."""
    rng = np.random.default_rng(1)
    actions = np.repeat(rng.uniform(-0.12, 0.12, (TICKS // 5, N_JOINTS, 1)), 5, axis=0)
    actions[:15] = 0.0  # at home until the ball has been seen
    # Episode j of the first four sees the motion j + 1 substeps late: together they see every substep.
    late = {name: [H * (j + 1) for j in range(SUBSTEPS)] + [d[key] for d in DELAYS] for key, name in NAMES.items()}
    late = {name: np.array(seconds) for name, seconds in late.items()}
    late |= {name: np.full(P, seconds) for name, seconds in zip(LATENCIES[3:], (0.055, 0.065), strict=True)}
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


def to_bridge(motion, delays, unit=FINEST):
    """The motion as bytes through the bridge's own receivers: first tick of the policy, what it saw, the bridge."""
    drive = DriveParams(switch_on_time=0.01, homing_time=0.01, following_error=9.0)  # somebody else moves the carriage
    emulators = [AxisEmulator("cmmt", 0.0, 0.0, 10.0, drive, AxisUnits(position=unit)) for _ in FESTO_JOINTS]
    profile = CmmtProfile(position_unit=unit)
    axes = FestoAxes(
        [Axis(name, emulator, profile, -0.99, 0.99) for name, emulator in zip("xy", emulators, strict=True)],
        AxesConfig(max_error=9.0),
    )
    session = EgmSession(EgmConfig(controller_address=HOME, ramp_in=0.0))
    loose = SafetyConfig(following_error=(9.0,) * N_JOINTS)  # the robot moves as it was recorded, not as it is told
    policy = Recording()
    config = BridgeConfig(delays=ObservationDelays(**delays), balls_needed=0)
    bridge = Bridge(session, axes, Tracker(TrackerConfig()), SafetyGate(config=loose), policy, config)
    first, warm_up = None, -200
    axes.enable()
    for i in range(warm_up, len(motion)):
        now, state = START + i * H, motion[max(i, 0)]
        for j, emulator in zip(FESTO_JOINTS, emulators, strict=True):
            emulator.step(now, float(state[3 + j]), 0.0)
        position = state[[3 + j for j in ABB_JOINTS]]
        assert session.receive(
            encode_robot(i - warm_up, round(now * 1000), position, position, True, True, True), ADDRESS, now
        )
        assert bridge.arm_received(now) is not None
        frame = BallSample(i - warm_up, 1, now, None if i < 0 else state[:3])
        bridge.tracker_received(encode(frame), HOME, now)
        if i == -150:
            axes.home()
        axes.cycle(now)
        bridge.axes_received(axes.state.position, axes.state.received)
        if i == -2:
            bridge.arm(now)
        if i % SUBSTEPS == 0:
            bridge.tick(now, now)
            if first is None and bridge.state is BridgeState.ACTIVE:
                first = i // SUBSTEPS
    return first, np.array(policy.seen), bridge


@pytest.mark.parametrize("which", range(len(DELAYS)))
def test_the_bridge_shows_what_the_simulator_shows(played, which):
    motion, shown, _ = played
    assert np.ptp(motion, axis=0).min() > 0.02  # everything moves
    first, seen, bridge = to_bridge(motion, DELAYS[which])
    assert first <= 5 and len(seen) >= 60 and not bridge.gate.faults
    expected = shown[first : first + len(seen), :, which]
    error = np.abs(seen - expected).max(axis=0)
    assert error.max() < 1e-6, error
    assert error[:3].max() < 1e-7 and error[3:5].max() < 2e-9 and error[5:].max() < 1e-9


def test_what_the_axes_usual_resolution_costs(played):
    """Half a micrometre of rounding, which the bar of 1e-6 just leaves room for."""
    motion, shown, _ = played
    first, seen, _ = to_bridge(motion, DELAYS[0], MICROMETRE)
    error = np.abs(seen - shown[first : first + len(seen), :, 0]).max(axis=0)
    assert 1e-7 < error[3:5].max() < 0.51e-6


def test_a_wrong_delay_would_be_noticed(played):
    motion, shown, _ = played
    for name, columns, least in (("ball", slice(0, 3), 1e-2), ("arm", slice(5, 11), 1e-3), ("axes", slice(3, 5), 1e-4)):
        wrong = DELAYS[0] | {name: DELAYS[0][name] - 0.004}
        first, seen, _ = to_bridge(motion, wrong)
        error = np.abs(seen - shown[first : first + len(seen), :, 0]).max(axis=0)
        assert error[columns].max() > least, name


def test_history_interpolates_holds_and_forgets():
    history = History(length=4, longest_hold=0.05)
    assert history.at(0.0) is None and history.newest is None and history.slope(1.0) is None
    for time, value in ((1.0, 0.0), (1.1, 1.0), (1.3, 5.0)):
        assert history.add(time, np.array([value, -value]))
    assert not history.add(1.3, np.zeros(2)) and not history.add(1.2, np.zeros(2))
    for time, value in ((0.0, 0.0), (1.0, 0.0), (1.05, 0.5), (1.1, 1.0), (1.2, 3.0), (1.3, 5.0), (1.34, 5.0)):
        np.testing.assert_allclose(history.at(time), [value, -value], atol=1e-12)
    assert history.at(1.3501) is None
    np.testing.assert_allclose(history.slope(1.0), np.polyfit([1.0, 1.1, 1.3], [0, 1, 5], 1)[0] * np.array([1, -1]))
    assert history.slope(0.15) is None  # one sample alone
    for time in (1.4, 1.5):
        history.add(time, np.zeros(2))
    assert len(history) == 4
    np.testing.assert_allclose(history.at(0.0), [1.0, -1.0])  # the oldest that is left


def test_nothing_is_observed_while_a_device_is_silent():
    feedback = Feedback(ball=History(longest_hold=0.06), axes=History(), arm=ArmHistory())
    position, velocity = joints(feedback)
    assert np.isnan(position).all() and not velocity.any()
    feedback.ball.add(1.0, np.zeros(3))
    feedback.axes.add(1.0, np.ones(2))
    assert observe(feedback, ObservationDelays(), 1.0) is None
    feedback.arm.add(1.0, np.full(6, 2.0))
    delays = ObservationDelays(ball=0.04)
    np.testing.assert_array_equal(observe(feedback, delays, 1.04), [0, 0, 0, 1, 1, *[2] * 6])
    assert observe(feedback, delays, 1.051) is None  # the joints' are too old
    for name in ("ball", "arm", "axes"):
        for seconds in (-0.001, 0.2, np.nan):
            with pytest.raises(ValueError, match=f"{name}: expected 0 to 0.1 s, got"):
                ObservationDelays(**{name: seconds})
