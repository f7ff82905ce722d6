"""The safety gate under requests, measurements and faults that try to get past it."""

from __future__ import annotations

import copy
import math
import re
from collections import deque
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from mjx_tt.robot import mjcf
from robot_io.contract import JOINT_NAMES
from robot_io.errors import RefusedError
from robot_io.limits import LIMITS, limit_velocity
from robot_io.safety.clearance import BLADE, RobotGeometry
from robot_io.safety.config import SLACK
from robot_io.safety.faults import Cause, FaultLatch
from robot_io.safety.gate import GateState, SafetyConfig, SafetyGate
from robot_io.safety.ways import slow_down

T = 1 / 75
LOWER, UPPER, V_MAX, A_MAX, MARGIN = (
    np.array(getattr(LIMITS, name)) for name in ("lower", "upper", "velocity", "acceleration", "margin")
)
STEP, JERK = A_MAX * T, 2 * A_MAX / T
REST = math.ceil((V_MAX / STEP).max()) + 1  # commands until the fastest joint is at rest
GEOMETRY = RobotGeometry.load()
HOME, ZERO = GEOMETRY.home, np.zeros(8)
MARGINS = np.array([{"table": 0.02, "self": 0.02, "floor": 0.17}[kind] for kind in GEOMETRY.kinds])


class Ideal:
    """A gate and a robot that is always where it is sent, ticking at 75 Hz."""

    def __init__(self, config: SafetyConfig | None = None, position=HOME, arm: bool = True) -> None:
        self.gate, self.now = SafetyGate(geometry=GEOMETRY, config=config), 100.0
        self.position, self.velocity = np.array(position, float), np.zeros(8)
        self.sent: list = []
        if arm:
            self.gate.arm(self.position, self.now, ZERO)

    def tick(self, request=ZERO, measured=None):
        sent = self.gate.command(request, self.position if measured is None else measured, self.velocity, self.now)
        if np.isfinite(sent.position).all():
            self.position, self.velocity = sent.position, sent.velocity
        self.now += T
        self.sent.append(sent)
        return sent

    @property
    def velocities(self):  # (8, ticks), from rest
        return np.stack([ZERO, *(s.velocity for s in self.sent)], axis=1)

    @property
    def positions(self):
        return np.stack([s.position for s in self.sent], axis=1)


def keeps_limits(velocities, positions):
    """velocities (8, ticks, ...) from rest, positions (8, ticks, ...)."""
    acceleration = np.diff(velocities, axis=1) / T
    jerk = np.diff(acceleration, axis=1, prepend=np.zeros_like(acceleration[:, :1])) / T
    column = (slice(None),) + (None,) * (velocities.ndim - 1)
    for values, bound in ((velocities, V_MAX), (acceleration, A_MAX), (jerk, JERK)):
        assert (np.abs(values) <= bound[column] * (1 + 1e-9)).all()
    assert (positions <= (UPPER - MARGIN)[column] + 1e-9).all() and (positions >= (LOWER + MARGIN)[column] - 1e-9).all()
    return np.abs(jerk).max(axis=tuple(range(1, jerk.ndim))) / JERK


# --- a million requests, vectorised: the kinematic limiter


def adversarial(kind, ticks, columns, rng):
    """Requests (ticks, 8, columns)."""
    shape, v = (ticks, 8, columns), V_MAX[:, None]
    t = np.arange(ticks)[:, None, None]
    sign = np.where(rng.random((8, columns)) < 0.5, 1.0, -1.0)
    if kind == "random":
        return rng.uniform(-2, 2, shape) * v
    if kind == "bang_bang":
        return np.where((t // rng.integers(1, 60, (8, columns))) % 2, 1.0, -1.0) * sign * 2 * v
    if kind == "resonant":  # half a period to reach full speed and back, and around it
        half = 2 * V_MAX[:, None] / (A_MAX[:, None] * T) * rng.uniform(0.5, 2.0, (8, columns))
        return np.where((t // np.maximum(half, 1)) % 2, 1.0, -1.0) * sign * v
    if kind == "drift":  # slowly into the limits, and along them
        return np.broadcast_to(sign * v * 10.0 ** rng.uniform(-3, 0, (8, columns)), shape)
    sizes = np.array([5e-324, 1e-310, -1e-308, 1e308, -1.7e308, 0.0, -0.0])  # "extreme"
    return rng.choice(sizes, shape)


@pytest.mark.parametrize("kind", ["random", "bang_bang", "resonant", "drift", "extreme"])
def test_two_hundred_thousand_requests_of_each_kind_keep_every_limit(kind):
    """Position, velocity, acceleration and jerk; and at every tick braking is within them: the limiter leaves the
    braked velocity as it is, and the joints come to rest inside the range."""
    ticks, columns = 800, 250
    requests = adversarial(kind, ticks, columns, np.random.default_rng(0))
    column, step = np.repeat(HOME[:, None], columns, axis=1), STEP[:, None]
    velocity, velocities, positions = np.zeros_like(column), [np.zeros_like(column)], []
    for request in requests:
        velocity = limit_velocity(request, velocity, column, T)
        column = column + velocity * T
        velocities.append(velocity)
        positions.append(column)
        braked = velocity - np.clip(velocity, -step, step)
        np.testing.assert_array_less(np.abs(limit_velocity(braked, velocity, column, T) - braked), 1e-12)
    speed = np.moveaxis(np.array(velocities[1:]), 0, 1)
    stop = np.moveaxis(np.array(positions), 0, 1) + np.sign(speed) * braking_distance(np.abs(speed))
    low, high = (LOWER + MARGIN)[:, None, None], (UPPER - MARGIN)[:, None, None]
    assert (stop <= high + 1e-9).all() and (stop >= low - 1e-9).all()
    worst = keeps_limits(np.moveaxis(np.array(velocities), 0, 1), np.moveaxis(np.array(positions), 0, 1))
    if kind in ("random", "bang_bang", "resonant"):
        assert (worst > 0.99).all(), "the bound of the jerk is reached: 2 a / T is the smallest there is"


def braking_distance(speed):
    """Way (8, ...) after the present period when the speed falls by a T each period: an arithmetic series."""
    column = (slice(None),) + (None,) * (speed.ndim - 1)
    n = np.floor(speed / STEP[column] * (1 + 1e-12))
    return T * (n * speed - STEP[column] * n * (n + 1) / 2)


# --- thousands of requests through the whole gate


def attack(position, rng):
    """The velocity (8,) that makes the smallest gap over its margin fall the fastest, every joint at its full speed."""
    q = position[:, None] + 1e-5 * np.concatenate([np.eye(8), -np.eye(8)], axis=1)
    gaps = GEOMETRY.gaps(q) - MARGINS[:, None]
    row = GEOMETRY.gaps(position[:, None])[:, 0] - MARGINS
    row = int(row.argmin()) if rng.random() < 0.8 else int(rng.integers(len(row)))
    slope = gaps[row, :8] - gaps[row, 8:]
    return np.where(np.abs(slope) > 1e-12, -np.sign(slope), rng.choice([-1.0, 1.0], 8)) * V_MAX


def adversary(rng):
    """Requests by position, changing their mind at random: attacks, bang-bang, wandering, drift."""
    while True:
        kind, ticks = rng.integers(4), rng.integers(5, 60)
        held = rng.choice([-2.0, 2.0], 8) * V_MAX
        speed = rng.uniform(0.02, 1.0)
        position = yield held
        for _ in range(ticks):
            request = (attack(position, rng), held, rng.uniform(-1, 1, 8) * V_MAX, 0.05 * attack(position, rng))[kind]
            position = yield request * (speed if kind == 0 else 1.0)


class Distances:
    """MuJoCo's own distances of what the gate watches."""

    def __init__(self) -> None:
        self.model = mjcf.load_model()
        self.data = mujoco.MjData(self.model)
        names = [row.replace("the table", "col_table").replace("the ", "").split(" to ") for row in GEOMETRY.rows]
        self.pairs = [tuple(self.model.geom(n).id for n in pair) for pair in names]

    def least(self, position, margins=MARGINS):
        """Smallest distance over its margin [m]."""
        self.data.qpos[:] = position
        mujoco.mj_kinematics(self.model, self.data)
        distances = [mujoco.mj_geomDistance(self.model, self.data, *pair, 3.0, None) for pair in self.pairs]
        return (np.array(distances) - margins).min()


@pytest.fixture(scope="module")
def distances():
    return Distances()


@pytest.fixture(scope="module")
def attacked():
    """Eight robots under attack for 300 ticks each."""
    robots = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        player, ideal = adversary(rng), Ideal()
        request = next(player)
        for _ in range(300):
            ideal.tick(request)
            request = player.send(ideal.position)
        assert ideal.gate.state is GateState.ARMED
        robots.append(ideal)
    return robots


def closest_of_attack_on_delays(config, distances):
    """Smallest distance [m] of a robot whose arm follows later than the gate believes, and its axes earlier.

    It is attacked where it is, not where its reference is: at random, by arm and axes against each other.
    """
    rng, ideal, request = np.random.default_rng(2), Ideal(config), ZERO
    arm = np.arange(8) > 1
    for tick in range(600):
        if tick % 25 == 0:
            kind, held = rng.integers(3), rng.choice([-1.0, 1.0], 8) * V_MAX
        before = ideal.sent[-4].position if tick > 4 else HOME
        towards = attack(np.where(arm, ideal.position, before), rng)
        request = (towards, held, np.where(arm, -towards, towards))[kind]
        ideal.tick(request)
    times = T * np.arange(len(ideal.sent))
    delays = np.where(arm, 0.071 + 0.017, 0.0645 - 0.017)
    there = [np.interp(times - d, times, row) for d, row in zip(delays, ideal.positions, strict=True)]
    return min(distances.least(position, 0.0) for position in np.array(there).T)


def test_the_robot_keeps_its_distance_while_its_drives_delays_are_off_by_what_the_gate_is_told(distances, monkeypatch):
    """A gate that takes all delays for equal lets the same attack touch."""
    assert closest_of_attack_on_delays(None, distances) > 0.01 - SLACK
    # Proofs against silence and blocked joints keep it away too.
    monkeypatch.setattr("robot_io.safety.gate.blocked", lambda way, low, high: way)
    equal = SafetyConfig(drive_delay=(0.071,) * 8, drive_delay_error=0.0, silence=(0.004,) * 8)
    assert closest_of_attack_on_delays(equal, distances) < 0.005


def test_attacks_keep_every_limit_and_are_stopped_by_every_rule(attacked):
    for ideal in attacked:
        keeps_limits(ideal.velocities, ideal.positions)
    changed = [name for ideal in attacked for sent in ideal.sent for name in sent.changed]
    for name in ("velocity", "acceleration", "position", "clearance"):
        assert changed.count(name) > 100


def test_attacks_keep_the_margins_by_mujocos_distances(attacked, distances):
    """At every tick and at two places between ticks; they come as close as allowed."""
    closest = np.inf
    for ideal in attacked:
        before = HOME
        for sent in ideal.sent:
            for share, allowed in ((1 / 3, SLACK), (2 / 3, SLACK), (1.0, 0.0)):
                gap = distances.least(before + share * (sent.position - before))
                assert gap > -allowed - 1e-6
                closest = min(closest, gap)
            before = sent.position
    assert closest < 0.002


def test_without_the_look_ahead_the_same_attack_ends_in_contact(distances):
    """So these attacks are some, and the margins are kept by the gate."""
    rng = np.random.default_rng(0)
    player, position, velocity = adversary(rng), HOME, ZERO
    request, deepest = next(player), np.inf
    for _ in range(300):
        velocity = limit_velocity(request, velocity, position, T)
        position = position + velocity * T
        deepest = min(deepest, distances.least(position))
        request = player.send(position)
    assert deepest < -0.05


def test_braking_from_every_accepted_state_is_safe_and_allowed(attacked, distances):
    """Braking is played out from states on the attacked robots' ways: inside all limits, and clear by MuJoCo's
    distances at every tick and half way between ticks."""
    rng = np.random.default_rng(0)
    for ideal in attacked:
        for i in rng.integers(0, len(ideal.sent), 15):
            position, velocity = ideal.sent[i].position, ideal.sent[i].velocity
            for _ in range(REST):
                braked = np.sign(velocity) * np.maximum(np.abs(velocity) - STEP, 0.0)
                np.testing.assert_allclose(limit_velocity(braked, velocity, position, T), braked, atol=1e-12)
                half, position, velocity = position + 0.5 * T * braked, position + braked * T, braked
                assert distances.least(half) > -SLACK - 1e-6 and distances.least(position) > -1e-6
            assert not velocity.any()


def test_in_free_space_the_gate_is_the_simulations_limiter_bit_for_bit():
    """Apart from the room that it keeps for the drives: at the ends of the ranges, and below full speed.

    No device waits for anybody here: what it would do in silence asks for more room than these places have.
    """
    rng = np.random.default_rng(3)
    config = SafetyConfig(silence=(0.004,) * 8)
    speed = tuple((0.9 * V_MAX).tolist())
    limits = replace(LIMITS, margin=SafetyConfig().overshoot, velocity=speed, policy_velocity=speed)
    for _ in range(10):
        ideal, velocity, reference = Ideal(config), ZERO, HOME
        for tick in range(40):
            if tick % 7 == 0:
                request = rng.uniform(-1.5, 1.5, 8) * V_MAX * [1, 1, 0.3, 0.1, 0.1, 1, 0.5, 1]
            velocity = limit_velocity(request, velocity, reference, T, limits)
            reference = reference + velocity * T
            sent = ideal.tick(request)
            np.testing.assert_array_equal(sent.velocity, velocity)
            np.testing.assert_array_equal(sent.position, reference)
            assert "clearance" not in sent.changed


def test_what_was_changed_is_told():
    ideal = Ideal()
    assert ideal.tick(0.5 * STEP).changed == ()
    assert ideal.tick(0.5 * STEP + 1.1 * STEP).changed == ("acceleration",)
    assert ideal.tick(3 * V_MAX).changed == ("velocity", "acceleration")
    assert ideal.tick(-0.9 * np.eye(8)[0] * V_MAX).changed == ("acceleration",)


def test_speed_scale_slows_requests_and_limits():
    ideal = Ideal(SafetyConfig(speed_scale=0.1))
    sent = ideal.tick(2 * STEP)
    np.testing.assert_allclose(sent.velocity, 0.2 * STEP)
    assert sent.changed == ("speed_scale",)
    for _ in range(20):
        sent = ideal.tick([5.0, 0, 0, 0, 0, 0, 0, 0])
    assert sent.velocity[0] == pytest.approx(0.1 * 0.9 * V_MAX[0]) and sent.changed == ("speed_scale", "velocity")


# --- arming


def test_nothing_moves_before_arming():
    rng = np.random.default_rng(0)
    ideal = Ideal(arm=False)
    for _ in range(200):
        measured = HOME + rng.uniform(-0.1, 0.1, 8)
        sent = ideal.tick(rng.uniform(-2, 2, 8) * V_MAX, measured)
        assert not sent.velocity.any() and sent.state is GateState.DISARMED and sent.changed == ("disarmed",)
        np.testing.assert_array_equal(sent.position, measured)
    sent = ideal.tick(V_MAX, np.full(8, np.nan))
    np.testing.assert_array_equal(sent.position, measured)  # the last that was known
    assert not sent.velocity.any() and not ideal.gate.faults and Cause.NON_FINITE_FEEDBACK in ideal.gate.present


@pytest.mark.parametrize("unreferenced", [False, True])
def test_axes_without_a_reference_hide_no_limit_while_the_robot_is_armed_or_moves(unreferenced):
    ideal, beyond = Ideal(), np.where(np.arange(8) == 0, -3.0, HOME)
    ideal.gate.unreferenced = unreferenced
    for _ in range(20):
        ideal.tick(0.5 * V_MAX)
    ideal.tick(measured=beyond)
    assert Cause.LIMIT in ideal.gate.present and ideal.gate.state is GateState.FAULT
    while not ideal.gate.at_rest:
        assert Cause.LIMIT in ideal.gate.present
        ideal.tick(measured=beyond)
    for _ in range(3):
        ideal.tick(measured=beyond)
    assert (Cause.LIMIT in ideal.gate.present) != unreferenced


def changed_home(joint, value):
    return np.where(np.arange(8) == joint, value, HOME)


@pytest.mark.parametrize(
    ("position", "velocity", "message"),
    [
        (changed_home(3, UPPER[3]), ZERO, r"joint_2 is at 1.9199, allowed is \[.*, 1.90\d+\] rad; jog it back"),
        (
            changed_home(0, -1.0),
            ZERO,
            r"gantry_x is at -1.0000, allowed is \[-0.99\d+, .* m; move it by its drive's own",
        ),
        (changed_home(0, -2.0), ZERO, "gantry_x is at -2.0000, allowed is"),
        (changed_home(7, np.nan), ZERO, "measured position: joint_6 is nan"),
        (changed_home(7, np.inf), ZERO, "measured position: joint_6 is inf"),
        (HOME[:6], ZERO, r"measured position is float64 \(6,\), needed are 8 real numbers"),
        (["a"] * 8, ZERO, "needed are 8 real numbers"),
        (HOME, np.eye(8)[2], "joint_1 1, allowed is 0.05 rad/s, it must be at rest"),
        (HOME, np.nan * ZERO, "measured velocity: gantry_x is nan"),
        (HOME, None, "no measured velocity yet"),
        (np.array([0, 0.4, 0, 1.6, 0, 0, 0.1, 0]), ZERO, "col_.* to the table: -.* m; jog it away"),
    ],
)
def test_arming_is_refused(position, velocity, message):
    ideal = Ideal(arm=False)
    with pytest.raises(RefusedError, match=message):
        ideal.gate.arm(position, 0.0, velocity)
    assert ideal.gate.state is GateState.DISARMED and not ideal.tick(V_MAX).velocity.any()


def test_arming_is_refused_while_armed_moving_faulty_or_pressed():
    ideal = Ideal()
    with pytest.raises(RefusedError, match="armed or still stopping"):
        ideal.gate.arm(HOME, 0.0, ZERO)
    ideal.tick(V_MAX)
    ideal.gate.brake(ideal.now)
    with pytest.raises(RefusedError, match="still stopping"):
        ideal.gate.arm(HOME, 0.0, ZERO)
    with pytest.raises(RefusedError, match="still moves"):
        ideal.gate.disarm(ideal.now)
    ideal.gate.fault(Cause.OPERATOR, "asked to", ideal.now)
    with pytest.raises(RefusedError, match="cannot reset: it still moves"):
        ideal.gate.reset(ideal.now)
    with pytest.raises(RefusedError, match="OPERATOR at .* asked to; reset it first"):
        ideal.gate.arm(HOME, 0.0, ZERO)
    pressed = Ideal(arm=False)
    pressed.gate.condition(Cause.ARM_NOT_READY, True, "motors are off", 0.0)
    with pytest.raises(RefusedError, match="not armed: ARM_NOT_READY: motors are off"):
        pressed.gate.arm(HOME, 0.0, ZERO)
    pressed.gate.condition(Cause.ARM_NOT_READY, False, "", 0.0)
    pressed.gate.arm(HOME, 0.0, ZERO)


def test_a_joint_a_little_inside_its_margin_is_led_out_of_it():
    """A fifth of a T^2 beyond the limiter's margin: armed, and within the acceleration limit brought back."""
    start = HOME.copy()
    start[[0, 7]] = (UPPER - MARGIN + 0.2 * STEP * T)[[0, 7]]
    ideal = Ideal(position=start)
    for _ in range(5):
        ideal.tick()
    assert (ideal.position <= UPPER - MARGIN + 1e-9).all()
    assert (np.abs(np.diff(ideal.velocities, axis=1)) <= STEP[:, None] * (1 + 1e-9)).all()


def test_braking_holds_and_can_be_armed_again():
    ideal = Ideal()
    for _ in range(8):
        ideal.tick([1.5, 0, 0, 0, 0, 0, 0, 2.0])
    ideal.gate.brake(ideal.now)
    for _ in range(REST):
        sent = ideal.tick(V_MAX)
        assert sent.state is GateState.STOPPING and sent.changed == ("stopping",)
    assert ideal.gate.at_rest and not sent.velocity.any()
    keeps_limits(ideal.velocities, ideal.positions)
    held = sent.position
    np.testing.assert_array_equal(ideal.tick(V_MAX).position, held)
    ideal.gate.arm(held, ideal.now)
    assert ideal.tick(0.1 * STEP).velocity.any()


# --- inside a margin


def test_inside_a_margin_only_motion_out_of_it_passes():
    """Armed 1 cm above the table: no request brings it down, one upwards brings it out, and then the margin is kept."""
    low, high = 0.0, 1.5
    for _ in range(50):
        q = np.array([0.0, 0.45, 0.0, 0.5 * (low + high), 0.0, 0.0, 0.1, 0.0])
        low, high = (q[3], high) if GEOMETRY.gaps(q[:, None]).min() > 0.01 else (low, q[3])
    ideal, rng = Ideal(position=q), np.random.default_rng(0)

    def gap():
        return GEOMETRY.gaps(ideal.position[:, None])[:, 0].min()

    before = start = gap()
    assert 0.0099 < start < 0.0101
    for _ in range(40):
        sent = ideal.tick(attack(ideal.position, rng))
        assert gap() >= before - 1e-12
        assert "escape" in sent.changed and (np.abs(sent.velocity) <= 0.05 * V_MAX + 1e-12).all()
        assert sent.velocity.any() <= (gap() > before)
        before = gap()
    assert not ideal.tick(np.eye(8)[0]).velocity.any() and gap() == before  # along the table is not out of it
    up = np.array([0, 0, 0, -1.0, 0, 0, 0, 0]) * V_MAX
    for _ in range(60):
        ideal.tick(up)
    assert gap() > 0.02 and ideal.velocities[3].min() < -0.3 * V_MAX[3]  # fast again once it is out
    for _ in range(60):
        ideal.tick(attack(ideal.position, rng))
        assert gap() > 0.02 - 1e-9


# --- faults


def bad_request(value):
    return lambda ideal: ideal.tick(changed_home(5, value))


EVENTS = {  # what makes each cause, of a robot at Ideal; those that last end with the next good tick unless they stay
    Cause.NON_FINITE_COMMAND: bad_request(np.nan),
    Cause.MALFORMED_COMMAND: lambda ideal: ideal.tick(np.zeros(7)),
    Cause.NON_FINITE_FEEDBACK: lambda ideal: ideal.tick(ZERO, np.full(8, np.inf)),
    Cause.LIMIT: lambda ideal: ideal.tick(ZERO, changed_home(2, 3.0)),
    Cause.CLEARANCE: lambda ideal: ideal.tick(ZERO, np.array([0, 0.4, 0, 1.6, 0, 0, 0.1, 0])),
    Cause.ESTOP: lambda ideal: ideal.gate.estop(True, ideal.now),
    Cause.AXIS_LOST: lambda ideal: ideal.gate.condition(Cause.AXIS_LOST, True, "no answer", ideal.now),
    Cause.ARM_NOT_READY: lambda ideal: ideal.gate.condition(Cause.ARM_NOT_READY, True, "motors are off", ideal.now),
    Cause.INTERNAL: lambda ideal: ideal.gate.fault(Cause.INTERNAL, "made up", ideal.now),
    Cause.OPERATOR: lambda ideal: ideal.gate.fault(Cause.OPERATOR, "asked to", ideal.now),
    Cause.STALE_ARM: lambda ideal: ideal.gate.check(ideal.now, 0.06, 0, 0, True, 0),
    Cause.STALE_AXES: lambda ideal: ideal.gate.check(ideal.now, 0, np.inf, 0, True, 0),
    Cause.STALE_TRACKER: lambda ideal: ideal.gate.check(ideal.now, 0, 0, np.nan, True, 0),
}
ENDS = {
    Cause.ESTOP: lambda ideal: ideal.gate.estop(False, ideal.now),
    Cause.AXIS_LOST: lambda ideal: ideal.gate.condition(Cause.AXIS_LOST, False, "", ideal.now),
    Cause.ARM_NOT_READY: lambda ideal: ideal.gate.condition(Cause.ARM_NOT_READY, False, "", ideal.now),
    **{
        c: lambda ideal: ideal.gate.check(ideal.now, 0, 0, 0, True, 0)
        for c in (Cause.STALE_ARM, Cause.STALE_AXES, Cause.STALE_TRACKER)
    },
}


def test_a_thousand_random_fault_sequences():
    """A few ticks of motion, a fault, others while it brakes: the first stays the cause, all are listed, every joint is
    at rest within v / a and stays there, no limit is passed on the way, and no reset works before the causes are
    gone."""
    rng = np.random.default_rng(0)
    causes = list(EVENTS)
    for _ in range(1000):
        ideal = Ideal()
        request = rng.uniform(-1, 1, 8) * V_MAX * rng.choice([0.2, 1.0])
        for _ in range(rng.integers(1, 8)):
            ideal.tick(request)
        assert ideal.gate.state is GateState.ARMED
        sequence = [causes[i] for i in rng.permutation(len(causes))[: rng.integers(1, 4)]]
        speed = np.abs(ideal.gate.velocity)
        sent_before = len(ideal.sent)
        started = ideal.now
        for cause in sequence:
            EVENTS[cause](ideal)
            assert ideal.gate.state is GateState.FAULT
            if rng.random() < 0.5:
                ideal.tick(request)
        while len(ideal.sent) - sent_before < math.ceil((speed / STEP).max()):
            ideal.tick(request)
        assert ideal.gate.at_rest and not ideal.tick(request).velocity.any()
        keeps_limits(ideal.velocities, ideal.positions)
        braking = np.abs(ideal.velocities[:, sent_before:])
        wanted = np.maximum(speed[:, None] - STEP[:, None] * np.arange(braking.shape[1]), 0.0)
        np.testing.assert_allclose(braking, wanted, atol=1e-12)
        assert [fault.cause for fault in ideal.gate.faults] == sequence
        assert all(started <= fault.time <= ideal.now and fault.sentence for fault in ideal.gate.faults)
        lasting = [cause for cause in sequence if cause in ENDS]
        if lasting:
            with pytest.raises(RefusedError, match=f"cannot reset while a cause is present.*{lasting[-1].name}"):
                ideal.gate.reset(ideal.now)
            assert [fault.cause for fault in ideal.gate.faults] == sequence
        for cause in lasting:
            ENDS[cause](ideal)
        ideal.gate.reset(ideal.now)
        assert ideal.gate.state is GateState.DISARMED and not ideal.gate.faults
        assert not ideal.tick(V_MAX).velocity.any()
        ideal.gate.arm(ideal.position, ideal.now)


@pytest.mark.parametrize(
    ("request_", "cause", "message"),
    [
        (changed_home(5, np.nan), Cause.NON_FINITE_COMMAND, "requested velocity: joint_4 is nan"),
        (changed_home(0, -np.inf), Cause.NON_FINITE_COMMAND, "gantry_x is -inf"),
        (changed_home(6, 1e-310), Cause.MALFORMED_COMMAND, "joint_5 is 1e-310, a subnormal number"),
        (changed_home(6, 1e-40).astype(np.float32), Cause.MALFORMED_COMMAND, "joint_5 is .*, a subnormal number"),
        (np.zeros((8, 1)), Cause.MALFORMED_COMMAND, r"float64 \(8, 1\), needed are 8 real numbers"),
        (np.zeros(9), Cause.MALFORMED_COMMAND, r"\(9,\)"),
        (np.zeros(8, complex), Cause.MALFORMED_COMMAND, "complex128"),
        (None, Cause.MALFORMED_COMMAND, "object"),
        ("12345678", Cause.MALFORMED_COMMAND, r"\(\)"),
        ([[1, 2], [3]], Cause.MALFORMED_COMMAND, "requested velocity is not an array"),
    ],
)
def test_a_request_that_is_no_velocity_brakes(request_, cause, message):
    ideal = Ideal()
    for _ in range(5):
        ideal.tick(0.5 * V_MAX)
    before = ideal.gate.velocity
    sent = ideal.tick(request_)
    np.testing.assert_allclose(np.abs(sent.velocity), np.maximum(np.abs(before) - STEP, 0.0))
    assert sent.state is GateState.FAULT and sent.changed == ("fault",)
    (fault,) = ideal.gate.faults
    assert fault.cause is cause and fault.time == pytest.approx(ideal.now - T)
    assert re.search(message, fault.sentence)
    for _ in range(REST):
        sent = ideal.tick(request_)
    assert not sent.velocity.any()
    with pytest.raises(RefusedError, match=cause.name):
        ideal.gate.reset(ideal.now)
    ideal.tick(ZERO)
    ideal.gate.reset(ideal.now)


def test_integers_and_single_precision_are_velocities():
    ideal = Ideal()
    ideal.tick([0] * 8)
    ideal.tick(np.full(8, 0.01, np.float32))
    assert ideal.gate.state is GateState.ARMED and ideal.sent[-1].velocity.dtype == np.float64


class Delayed(Ideal):
    """A robot that does what it was told ``delay`` ticks ago; joints listed as stuck stay where they are."""

    def __init__(self, delay, stuck=(), **kwargs) -> None:
        super().__init__(**kwargs)
        self.delay, self.free = delay, np.array([name not in stuck for name in JOINT_NAMES])

    def tick(self, request=ZERO, measured=None):
        old = self.sent[-self.delay].position if len(self.sent) >= self.delay else HOME
        self.velocity = ZERO
        sent = super().tick(request, np.where(self.free, old, HOME))
        self.velocity = ZERO
        return sent


def test_the_known_delay_is_no_following_error():
    for delay in (1, 5, 8, 10):
        ideal = Delayed(delay)
        for tick in range(200):
            ideal.tick(V_MAX * [0.5, 0.5, 1, 0.1, 0.1, 1, 0.5, 1] * np.sign(np.sin(tick / 7)))
        assert ideal.gate.state is GateState.ARMED


@pytest.mark.parametrize("joint", [0, 2, 7])
def test_a_joint_that_does_not_follow_is_a_fault(joint):
    ideal = Delayed(7, stuck=(JOINT_NAMES[joint],))
    request = 0.5 * V_MAX * np.eye(8)[joint]
    while ideal.gate.state is GateState.ARMED and len(ideal.sent) < 60:
        ideal.tick(request)
    (fault,) = ideal.gate.faults
    assert fault.cause is Cause.FOLLOWING_ERROR and JOINT_NAMES[joint] in fault.sentence
    assert fault.time - 100.0 < 0.5
    for _ in range(REST):
        ideal.tick(request)
    ideal.gate.reset(ideal.now)  # an event: over when it has happened
    ideal.gate.arm(HOME, ideal.now, ZERO)


def gap_of_blocked(seed, delay=8):
    """Smallest gap [m] of a robot that is attacked until a fault, and of which a joint is blocked where it is fast."""
    rng, ideal, place, side = np.random.default_rng(seed), Ideal(SafetyConfig(speed_scale=1.0)), None, 0.0
    joint, begin = int(rng.integers(8)), int(rng.integers(25, 60))
    before, nearest = HOME, np.inf
    for tick in range(160):
        measured = (ideal.sent[-delay].position if tick >= delay else HOME).copy()
        if place is None and tick > begin and abs(measured - before)[joint] > 0.45 * T * V_MAX[joint]:
            place, side = before[joint], np.sign(measured - before)[joint]
        before = measured.copy()
        if place is not None and (measured[joint] - place) * side > 0.0:
            measured[joint] = place
        nearest = min(nearest, GEOMETRY.gaps(measured[:, None]).min())
        if ideal.gate.faults:
            assert place is not None and ideal.gate.faults[0].cause is Cause.FOLLOWING_ERROR
            break
        if tick % 8 == 0:
            request = rng.uniform(-1, 1, 8) * V_MAX
        if tick > 20 and tick % 8 > 3:
            request = attack(measured, rng)
        ideal.velocity = ZERO
        ideal.tick(request, measured)
    return nearest


def test_a_joint_that_is_blocked_leads_the_others_into_nothing_before_it_is_noticed(monkeypatch):
    """An attack in a hundred: within the time from a command to its measurement, in which no fault can come."""
    assert min(gap_of_blocked(seed) for seed in (68, 84, 128)) > 0.0
    monkeypatch.setattr("robot_io.safety.gate.blocked", lambda way, low, high: way)
    with pytest.raises(AssertionError, match="CLEARANCE"):
        gap_of_blocked(84)


@pytest.mark.parametrize("joint", [3, 4])
def test_only_the_joints_brake_that_lead_to_what_comes_close(joint):
    """Joints 2 and 3 fold the arm onto the table and the base; gantry and joint 6 lead nowhere."""
    ideal = Ideal(SafetyConfig(speed_scale=1.0), HOME + 0.22 * np.eye(8)[1])
    request = V_MAX * (0.1 * np.eye(8)[[0, 7]].sum(axis=0) + 0.4 * np.eye(8)[joint])
    sent = [ideal.tick(request) for _ in range(60)]
    changed = np.array([s.velocity for s in sent if "clearance" in s.changed])
    assert len(changed) > 3 and (changed[:, joint] < 0.99 * request[joint]).all()
    np.testing.assert_allclose(changed[:, [0, 7]], np.broadcast_to(request[[0, 7]], (len(changed), 2)))
    assert (GEOMETRY.gaps(ideal.positions) > MARGINS[:, None] - SLACK).all()


@pytest.mark.parametrize("gap", [0.004, 0.008, 0.015])
def test_a_robot_armed_close_to_itself_gets_away(gap):
    """Joint 3 was folded until the robot almost touched itself; asked to unfold, it does."""
    fold = np.eye(8)[4]
    steps = HOME[:, None] + fold[:, None] * np.linspace(0.0, 1.7, 17001)
    place = steps[:, int(np.argmax(GEOMETRY.gaps(steps).min(axis=0) < gap))]
    ideal = Ideal(SafetyConfig(speed_scale=1.0), place)
    for _ in range(150):
        ideal.tick(-0.5 * V_MAX * fold)
    assert GEOMETRY.gaps(ideal.position[:, None]).min() > 0.1 and not ideal.gate.faults


def test_a_carriage_is_slowed_down_by_what_the_gap_lacks():
    """Towards the table's edge gaps fall by the carriage's way: 0.3 s at 1 m/s lack 0.02 m, and 1 mm more is kept."""
    start, velocity = HOME + 0.1 * np.eye(8)[1], np.array([0.5, 1.0, 0, 0, 0, 0, 0, 1.0])
    place = start + 0.3 * velocity
    least = GEOMETRY.gaps(place[:, None])[:, 0] - 1.0
    row = GEOMETRY.rows.index("col_upper_arm to the table")
    least[row] += 1.02
    slowed = slow_down(GEOMETRY, start, velocity, ZERO, place[:, None], least)
    np.testing.assert_allclose(slowed, [0.5, 1.0 - 0.021 / 0.3, 0, 0, 0, 0, 0, 1.0], atol=1e-6)


def test_measured_speed_far_above_its_limit_is_a_fault():
    ideal = Ideal()
    ideal.velocity = np.array([0, 0, 0, 0, 0, 0, 0, 1.6 * V_MAX[7]])
    ideal.tick()
    assert ideal.gate.faults[0].cause is Cause.LIMIT and "joint_6" in ideal.gate.faults[0].sentence


# --- watchdogs and time

FRESH = dict(arm_age=0.0, axes_age=0.0, tracker_age=0.0, ball_in_play=True, policy_age=0.0)


@pytest.mark.parametrize(
    ("age", "cause", "allowed"),
    [
        ("arm_age", Cause.STALE_ARM, 0.05),
        ("axes_age", Cause.STALE_AXES, 0.05),
        ("tracker_age", Cause.STALE_TRACKER, 0.035),
        ("policy_age", Cause.STALE_POLICY, 0.05),
    ],
)
def test_silence_is_a_fault(age, cause, allowed):
    for value in (1.01 * allowed, math.inf, math.nan):
        ideal = Ideal()
        ideal.now += 10.0  # armed long ago
        ideal.gate.check(ideal.now, **(FRESH | {age: 0.99 * allowed}))
        assert ideal.gate.state is GateState.ARMED
        ideal.gate.check(ideal.now, **(FRESH | {age: value}))
        assert [f.cause for f in ideal.gate.faults] == [cause]
        assert f"allowed is {allowed} s" in ideal.gate.faults[0].sentence


def test_a_silent_tracker_without_a_ball_and_a_policy_before_arming_are_none():
    ideal = Ideal()
    ideal.gate.check(ideal.now, **(FRESH | dict(tracker_age=math.inf, ball_in_play=False)))
    ideal.gate.check(ideal.now + 0.04, **(FRESH | dict(policy_age=5.0)))  # armed 0.04 s ago
    assert ideal.gate.state is GateState.ARMED
    ideal.gate.check(ideal.now + 0.06, **(FRESH | dict(policy_age=5.0)))
    assert ideal.gate.faults[0].cause is Cause.STALE_POLICY
    ideal.gate.check(ideal.now + 0.07, **(FRESH | dict(policy_age=5.0)))
    ideal.gate.reset(ideal.now + 0.08)  # no policy has to run while nothing is armed


def test_devices_that_are_not_there_yet_are_no_fault_but_nothing_is_armed():
    ideal = Ideal(arm=False)
    ideal.gate.check(ideal.now, **(FRESH | dict(arm_age=math.inf)))
    assert ideal.gate.state is GateState.DISARMED
    with pytest.raises(RefusedError, match="STALE_ARM: nothing heard from the arm's controller for inf s"):
        ideal.gate.arm(HOME, ideal.now, ZERO)
    ideal.gate.estop(True, ideal.now)  # the one condition that latches at all times
    assert ideal.gate.state is GateState.FAULT


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0.0, T, T + 0.06], "0.060 s between two commands, allowed is 0.03 s"),
        ([0.0, T, 0.5 * T], "time went back by 0.0067 s"),
        ([0.0, T, math.nan], "the time is nan"),
        ([0.1 * T * i for i in range(5)], "commands come faster than every 0.01333 s"),
    ],
)
def test_commands_out_of_time_are_a_fault(times, message):
    ideal = Ideal()
    for time in times:
        assert ideal.gate.state is GateState.ARMED
        ideal.gate.command(0.1 * STEP, ideal.gate.reference, ZERO, 100.0 + time)
    assert ideal.gate.faults[0].cause is Cause.TIMING and message in ideal.gate.faults[0].sentence


def test_late_ticks_that_catch_up_are_none():
    ideal, rng = Ideal(), np.random.default_rng(0)
    for i in range(300):
        late = rng.choice([0.0, 0.004, 0.013])
        ideal.gate.command(ZERO, HOME, ZERO, 100.0 + i * T + late)
    assert ideal.gate.state is GateState.ARMED


# --- a tick that comes late


def late_ticks(seed, ticks):
    """Moments at which a robot under attack is fast and near something: copies of its gate, with the time."""
    rng = np.random.default_rng(seed)
    player, ideal = adversary(rng), Ideal()
    request = next(player)
    for _ in range(ticks):
        ideal.tick(request)
        request = player.send(ideal.position)
        gate, near = ideal.gate, (GEOMETRY.gaps(ideal.position[:, None])[:, 0] - MARGINS).min() < 0.2
        if near and (np.abs(gate.velocity) > 0.5 * V_MAX).any():
            yield copy.deepcopy(gate, {id(gate.geometry): gate.geometry}), ideal.now - T


def check_late_tick(gate, now, gap, answered, distances):
    """The next tick comes ``gap`` seconds after the last, at ``now``; then the robot is braked. Least gaps [m] over the
    margins of what the devices are told, and of a robot that does at once as it is told, in velocities.

    answered: its packets are answered meanwhile, as when the tick alone is late; else it goes on as it was told last.
    """
    times = np.linspace(0.0, gap, 10)
    places = [gate.motion.at(now + t)[0] if answered else gate.start + gate.velocity * t for t in times]
    robot, real = places[-1], [places[-1]]
    now += gap
    for _ in range(REST + 1):
        velocity = gate.command(ZERO, gate.reference, gate.velocity, now).velocity
        places += [gate.start, gate.reference]
        robot = robot + velocity * T
        real.append(robot)
        now += T
    assert gate.at_rest and (gate.state is GateState.FAULT) == (gap > gate.config.late)
    return min(map(distances.least, places)), min(map(distances.least, real))


def check_late_ticks(count, distances):
    rng, done, closest = np.random.default_rng(1), 0, [np.inf, np.inf]
    for seed in range(1000):
        for gate, now in late_ticks(seed, 200):
            # A robot that nobody answers goes on until its controller's own time-out: that is beyond any gate.
            gap, answered = rng.uniform(T, 0.1), rng.random() < 0.5
            gap = gap if answered else rng.uniform(T, gate.config.late)
            found = check_late_tick(gate, now, gap, answered, distances)
            closest = [min(pair) for pair in zip(closest, found, strict=True)]
            assert found[0] > -0.005 and found[1] > -0.01, (seed, gap, answered, found)  # of the margins' 0.02 m
            done += 1
            if done == count:
                return closest
    raise AssertionError(f"only {done} moments to be late at")


def test_a_late_tick_does_not_eat_the_clearance(distances):
    check_late_ticks(60, distances)


@pytest.mark.slow
def test_three_thousand_late_ticks_do_not_eat_the_clearance(distances):
    check_late_ticks(3000, distances)


# --- nobody speaks to the devices any more


def gone_silent(gate, silence, again, distances):
    """Smallest distance [m] of a robot whose devices go on with their last command from now on, each until its own
    time-out, or until the computer speaks ``again`` after so many seconds; then they brake at their limits."""
    dt, end = 0.005, np.array(silence) + T
    position, velocity, least, time = gate.start, gate.velocity, np.inf, 0.0
    while velocity.any():
        braking = (time >= end) | (time >= again)
        position = position + dt * velocity
        velocity = np.where(braking, np.sign(velocity) * np.maximum(np.abs(velocity) - dt * A_MAX, 0.0), velocity)
        time += dt
        least = min(least, distances.least(position, 0.0))
    return least


def closest_in_silence(told, silence, moments, distances):
    """Of gates that are told of one silence, while another one comes."""
    rng, closest = np.random.default_rng(1), np.inf
    for seed in range(moments // 10):
        player, ideal = adversary(np.random.default_rng(seed)), Ideal(SafetyConfig(silence=told))
        request = next(player)
        for tick in range(200):
            ideal.tick(request)
            request = player.send(ideal.position)
            if tick % 20 == 19:
                again = rng.choice([np.inf, rng.uniform(0.0, max(silence))])
                closest = min(closest, gone_silent(ideal.gate, silence, again, distances))
    return closest


@pytest.mark.slow
def test_whatever_silence_leads_to_touches_nothing(distances):
    """At any moment of an attack, while braking too; a gate that is told of shorter silences lets the same touch."""
    for timeout in (0.1, 1.0):
        silence = (0.05,) * 2 + (timeout,) * 6
        assert closest_in_silence(silence, silence, 30, distances) > 0.005, timeout
    assert closest_in_silence((0.004,) * 8, silence, 30, distances) <= 0.0


# --- the rest


def test_a_mistake_of_the_gate_itself_brakes(monkeypatch):
    """Of any kind: what raises, and what lets too much pass."""
    for wrong in (lambda *_: 1 / 0, lambda wanted, braked: (braked + 2.1 * STEP, ())):
        ideal = Ideal()
        for _ in range(5):
            ideal.tick(0.5 * V_MAX)
        before = ideal.gate.velocity
        monkeypatch.setattr(ideal.gate, "_allowed", wrong)
        sent = ideal.tick(ZERO)
        np.testing.assert_allclose(np.abs(sent.velocity), np.maximum(np.abs(before) - STEP, 0.0))
        assert [f.cause for f in ideal.gate.faults] == [Cause.INTERNAL]


def test_what_was_sent_is_the_callers_own():
    ideal = Ideal()
    sent = ideal.tick(STEP)
    expected = sent.position.copy()
    sent.position[:], sent.velocity[:] = 1e3, 1e3
    np.testing.assert_array_equal(ideal.gate.reference, expected)


def test_latch_keeps_the_first_cause_and_lists_the_others():
    latch = FaultLatch()
    assert not latch and latch.first is None
    latch.event(Cause.LIMIT, "one", 1.0)
    latch.condition(Cause.ESTOP, True, "two", 2.0)
    latch.event(Cause.LIMIT, "again", 3.0)
    latch.condition(Cause.STALE_ARM, True, "noted", 4.0, latch=False)
    assert [(f.cause, f.time, f.sentence) for f in latch.all] == [(Cause.LIMIT, 1.0, "one"), (Cause.ESTOP, 2.0, "two")]
    assert str(latch.first) == "LIMIT at 1.000 s: one"
    with pytest.raises(RefusedError, match="ESTOP: two; STALE_ARM: noted"):
        latch.reset()
    latch.condition(Cause.ESTOP, False, "", 5.0)
    latch.condition(Cause.STALE_ARM, False, "", 5.0)
    assert len(latch.all) == 2
    latch.reset()
    assert not latch


@pytest.mark.parametrize(
    "wrong",
    [
        dict(speed_scale=0.0),
        dict(speed_scale=1.5),
        dict(table_margin=-0.01),
        dict(self_margin=math.nan),
        dict(late=0.0),
        dict(stale_arm=math.inf),
        dict(still=(1.0,) * 7),
        dict(following_error=(-1.0,) * 8),
        dict(feedback_delay=0.0),
    ],
)
def test_a_wrong_configuration_is_refused(wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}: expected .*, got"):
        replace(SafetyConfig(), **wrong)


# --- where the robot is, beside its reference


class Offset(Ideal):
    """A robot that is measured beside its reference, within the following-error limit."""

    def __init__(self, offset, **options) -> None:
        super().__init__(**options)
        self.offset = np.zeros(8)
        self.final = np.asarray(offset, float)

    def tick(self, request=ZERO, measured=None):
        self.offset += np.clip(self.final - self.offset, -0.002, 0.002)  # as a drift
        sent = super().tick(request, self.position + self.offset)
        return sent


@pytest.mark.parametrize("offset", [0.03, pytest.param(0.08, marks=pytest.mark.slow), 0.15])
def test_a_robot_beside_its_reference_does_not_come_into_the_table(offset):
    """Its joints 2 and 5 lead it down: the margin of the reference alone would let the measured blade through."""
    deepest = np.inf
    for seed in range(4):
        rng = np.random.default_rng(seed)
        robot = Offset([0, 0, 0, offset, 0.5 * offset, 0, 0, 0])
        for _ in range(100):  # it drifts where there is room
            robot.tick()
        for _ in range(250):
            robot.tick(attack(robot.position + robot.offset, rng))
            deepest = min(deepest, GEOMETRY.gaps((robot.position + robot.offset)[:, None]).min())
            if robot.gate.state is not GateState.ARMED:
                break
    assert deepest > -0.002


def blade_motion(positions):
    """Largest speed [m/s] and acceleration [m/s^2] of the blade's centre at positions (8, ticks), from rest at HOME."""
    way = GEOMETRY.middles(BLADE, np.concatenate([np.repeat(HOME[:, None], 2, axis=1), positions], axis=1))
    velocity = np.diff(way) / T
    return np.linalg.norm(velocity, axis=0).max(), np.linalg.norm(np.diff(velocity), axis=0).max() / T


def swing(position, direction):
    """Velocity (8,) at full speed of each joint that moves the blade along ``direction`` (3,)."""
    way = GEOMETRY.middles(BLADE, position[:, None] + 1e-5 * np.eye(8)) - GEOMETRY.middle(BLADE, position)[:, None]
    return V_MAX * np.where(direction @ way < 0.0, -1.0, 1.0)


@pytest.mark.parametrize("limits", [(100.0, 1000.0), (8.0, 150.0), (3.0, 150.0), (8.0, 60.0)])
def test_the_blade_keeps_its_limits_and_braking_keeps_them_too(limits):
    """Swings to and fro with every joint, which without limits reach 11 m/s and 200 m/s^2, ended by a fault."""
    speed, acceleration = limits
    found, changed = np.zeros(2), set()
    for seed in range(8):
        rng = np.random.default_rng(seed)
        ideal = Ideal(SafetyConfig(speed_scale=1.0, blade_speed=speed, blade_acceleration=acceleration))
        end, direction = rng.integers(40, 90), rng.normal(size=3) * [1.0, 1.0, 0.3]
        half = rng.integers(8, 25)
        for tick in range(105):
            if tick == end:
                ideal.gate.fault(Cause.OPERATOR, "stop", ideal.now)
            sign = -1.0 if tick // half % 2 else 1.0
            changed |= set(ideal.tick(sign * swing(ideal.position, direction)).changed)
        found = np.maximum(found, blade_motion(ideal.positions))
        keeps_limits(ideal.velocities, ideal.positions)
    assert (found <= np.array(limits) * (1 + 1e-9)).all(), found
    if limits[0] == 100.0:
        assert found[0] > 9.0 and found[1] > 165.0
    else:
        assert (found > 0.9 * np.array(limits)).any() and {"blade_speed", "blade_acceleration"} & changed


def test_the_rule_that_refuses_a_command_is_the_one_that_is_told():
    """Even braking breaks a limit that has become smaller on the way; nothing is near."""
    ideal = Ideal(SafetyConfig(speed_scale=1.0))
    for _ in range(8):
        ideal.tick(swing(ideal.position, np.array([0.0, 0.0, 1.0])))
    ideal.gate.config = replace(ideal.gate.config, blade_speed=0.1)
    changed = ideal.tick(swing(ideal.position, np.array([0.0, 0.0, 1.0]))).changed
    assert "blade_speed" in changed and "clearance" not in changed
    assert (np.abs(ideal.velocities[:, -1]) <= np.abs(ideal.velocities[:, -2])).all()  # it brakes


def test_attacks_keep_the_blades_limits(attacked):
    for ideal in attacked:
        speed, acceleration = blade_motion(ideal.positions)
        assert speed <= 8.0 * (1 + 1e-9) and acceleration <= 150.0 * (1 + 1e-9)


@pytest.mark.parametrize(
    "size, kept, least", [(0.01, 0.0, 0.005), (0.03, 0.0, 0.005), (0.1, 0.0, 0.005), (0.06, 0.97, 0.0)]
)
def test_a_noisy_measurement_within_the_following_error_stays_off_the_table(size, kept, least):
    """Noise of each joint of the arm, [rad], of which the share ``kept`` lasts; the measured arm is attacked.

    Noise that lasts grows while the arm brakes, beyond what was seen of it: it is only kept from contact.
    """
    nearest = np.inf
    for seed in range(2):
        rng = np.random.default_rng(seed)
        robot, noise = Ideal(SafetyConfig(speed_scale=1.0)), np.zeros(8)
        for tick in range(250):
            fresh = size * rng.uniform(-1, 1, 8) * math.sqrt(1.0 - kept**2)
            noise = np.clip(kept * noise + fresh, -size, size) * [0, 0, 1, 1, 1, 1, 1, 1]
            measured = robot.position + noise
            robot.tick(ZERO if tick < 75 else attack(measured, rng), measured)
            nearest = min(nearest, GEOMETRY.gaps(measured[:, None])[:5].min())
            if robot.gate.state is not GateState.ARMED:
                break
    assert nearest > least, nearest


@pytest.mark.parametrize("beside", [0.02, 0.03])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_measured_joint_keeps_its_range_beside_its_reference(sign, beside):
    """An arm that stands ``beside`` its reference, 80 ms late and 0.2 % fast, on a way to its limit at full speed."""
    joint = 6
    gate, q = SafetyGate(geometry=GEOMETRY), HOME.copy()
    late = deque([q.copy()] * 7, maxlen=7)  # references
    now, dt, started = 1.0, gate.period, q[joint]
    gate.arm(q, now, ZERO)
    found, before = [], q.copy()
    for i in range(160):
        measured = late[0].copy()
        measured[joint] += sign * beside * min(i / 20, 1.0) + 0.002 * (measured[joint] - started)
        request = np.zeros(8)
        request[joint] = sign * LIMITS.velocity[joint] if i > 60 else 0.0
        gate.command(request, measured, (measured - before) / dt, now)
        before, now = measured, now + dt
        late.append(gate.reference)
        found.append(measured[joint])
    limit = LIMITS.upper[joint] if sign > 0 else LIMITS.lower[joint]
    assert gate.state is GateState.ARMED, gate.faults
    assert sign * (limit - max(found, key=lambda x: sign * x)) > 0.0
