"""Joint diagnosis against a simulator of its own: fine Euler steps of the drive as the catalogue words it."""

from __future__ import annotations

import math
from dataclasses import astuple
from functools import cache

import numpy as np
import pytest

from mjx_tt.diagnosis.joint import (
    JointFinding,
    JointFindings,
    JointRecord,
    JointResponse,
    diagnose_joints,
    read_robot_csv,
)
from mjx_tt.diagnosis.joint.diagnose import parts
from mjx_tt.diagnosis.verdict import NOT_ADOPTED, Cause, Estimate, combined

DT = 2e-4
NOMINAL = JointResponse(action_delay=0.071, observation_delay=0.029)
IDEAL = {
    "delay": 0.1,
    "servo": 0.0,
    "servo_gain": 1.0,
    "lag": 0.0,
    "velocity_gain": 1.0,
    "velocity_limit": 1e9,
    "acceleration_limit": 1e9,
    "backlash": 0.0,
    "coulomb_friction": 0.0,
    "deadband": 0.0,
    "joint_offset": 0.0,
}


def euler(times, commands, queries, truths, extra=None):
    """Positions of each case's joint at its queries, from its commands; truths: parameters of each case.

    extra: what a drive may do beyond the catalogue: (step time, velocity, position, target, acceleration) -> velocity
    that is added, all (cases,).
    """
    n = len(truths)
    p = {name: np.array([t.get(name, IDEAL[name]) for t in truths]) for name in IDEAL}
    end = max(q[-1] for q in queries)
    steps = int(end / DT) + 2
    grid = np.arange(steps) * DT
    u = np.empty((steps, n))
    for i in range(n):
        # Commands and delays are multiples of DT: a step sees one command only.
        at = np.searchsorted(times[i] + p["delay"][i], grid + DT / 2) - 1
        u[:, i] = np.where(at >= 0, commands[i][np.maximum(at, 0)], 0.0)
    u[np.abs(u) < p["deadband"]] = 0.0
    u = np.where(np.abs(u) > p["coulomb_friction"], u - p["coulomb_friction"] * np.sign(u), 0.0) * p["velocity_gain"]
    u = np.clip(u, -p["velocity_limit"], p["velocity_limit"])
    v, q, out = np.zeros(n), np.zeros(n), np.zeros(n)
    path, followed, chase = np.empty((steps, n)), np.zeros(n), -np.expm1(-DT / np.maximum(p["servo"], 1e-9))
    instant = (p["lag"] == 0.0) & (p["acceleration_limit"] > 1e6)
    rate, most, half = -np.expm1(-DT / np.maximum(p["lag"], 1e-6)) / DT, p["acceleration_limit"], p["backlash"] / 2
    for k in range(steps):
        path[k] = out
        a = (u[k] - v) * rate
        np.minimum(a, most, out=a)
        np.maximum(a, -most, out=a)
        q = q + np.where(instant, u[k], v + 0.5 * a * DT) * DT
        v = v + a * DT
        followed = followed + (q - followed) * chase
        if extra is not None:
            q = q + extra(k * DT, v, q, u[k], a) * DT
        led = np.where(chase < 1.0, p["servo_gain"] * followed, q)
        out = np.minimum(np.maximum(out, led - half), led + half)
    return [np.interp(queries[i], grid, path[:, i]) + p["joint_offset"][i] for i in range(n)]


def command(rng, duration, kind, top):
    """A velocity command of a kind, at the control rate, that rests at first."""
    t = np.round((np.arange(0.0, duration, 1 / 75) + rng.uniform(0, 0.003)) / DT) * DT
    if kind == "steps":
        u, position, k = np.zeros(t.size), 0.0, 0
        while k < t.size:
            length = int(rng.integers(5, 60))
            u[k : k + length] = rng.uniform(0, 1) * (rng.choice([-1, 1]) if abs(position) < 0.2 else -np.sign(position))
            position, k = position + u[k] * length / 75, k + length
    elif kind == "sines":
        f, phase = rng.uniform(0.4, 2.5, 4), rng.uniform(0, 2 * np.pi, 4)
        u = np.sin(2 * np.pi * f[:, None] * t + phase[:, None]).mean(0) * 1.6
    elif kind == "chirp":
        u = np.sin(2 * np.pi * (0.5 * t + 0.5 * (2.0 / duration) * t * t))
    else:  # strokes with pauses between them
        u, begin = np.zeros(t.size), 0.3
        while begin < duration:
            length, size = rng.uniform(0.2, 0.6), rng.uniform(-1, 1)
            inside = (t - begin) / length
            u += np.where((inside > 0) & (inside < 1), size * np.sin(2 * np.pi * inside), 0.0)
            begin += length + rng.uniform(0.2, 1.0)
    u = np.where(t < 0.5, 0.0, top * np.clip(u, -1, 1))
    return t, u * min(1.0, 1.2 / np.abs(np.cumsum(u) / 75).max())  # stays within the joint's range


def measure(rng, clean, noise, size):
    """Measured positions with noise of a kind."""
    if noise == "ar1":
        e = rng.normal(0, size * math.sqrt(1 - 0.49), clean.size)
        for i in range(1, e.size):
            e[i] += 0.7 * e[i - 1]
    elif noise == "outliers":
        e = rng.normal(0, size, clean.size) + (rng.random(clean.size) < 0.01) * rng.normal(0, 20 * size, clean.size)
    elif noise == "quantised":
        return np.round(clean / (3 * size)) * (3 * size)
    else:
        e = rng.normal(0, size, clean.size)
    return clean + e


EFFECTS = tuple(name for name in IDEAL if name not in ("joint_offset", "servo", "servo_gain"))
KINDS = ("steps", "sines", "chirp", "strokes")
NOISES = ("white", "ar1", "outliers", "quantised")


def draw(rng, effect, top):
    """A size of an effect that a joint with commands up to ``top`` can show."""
    return {
        "delay": lambda: 0.1 + rng.choice([-1, 1]) * round(rng.uniform(0.006, 0.05) / DT) * DT,
        "lag": lambda: rng.uniform(0.008, 0.1),
        "velocity_gain": lambda: 1 + rng.choice([-1, 1]) * rng.uniform(0.02, 0.15),
        "velocity_limit": lambda: top * rng.uniform(0.4, 0.85),
        "acceleration_limit": lambda: top * rng.uniform(2.0, 6.0),
        "backlash": lambda: rng.uniform(0.003, 0.02),
        "coulomb_friction": lambda: top * rng.uniform(0.01, 0.08),
        "deadband": lambda: top * rng.uniform(0.06, 0.2),
    }[effect]()


def cases(seed, truths, duration, extra=None, kinds=KINDS, noises=NOISES):
    """Records of one joint each, for a list of functions (rng, top) -> truth."""
    rng = np.random.default_rng(seed)
    times, commands, queries, drawn = [], [], [], []
    for i, truth in enumerate(truths):
        top = rng.uniform(1.5, 4.0)
        t, u = command(rng, duration, kinds[i % len(kinds)], top)
        times.append(t)
        commands.append(u)
        queries.append(np.arange(0.0, duration, 1 / 125) + rng.uniform(0, 0.008))
        drawn.append(truth(rng, np.abs(u).max()))
    paths = euler(times, commands, queries, drawn, extra)
    records = []
    for i, path in enumerate(paths):
        noise = noises[(i // len(kinds)) % len(noises)]
        size = 10 ** rng.uniform(-4.3, -3.0)
        measured = 0.3 + measure(rng, path, noise, size)
        records.append(JointRecord("joint_2", times[i], commands[i], queries[i], measured))
    return records, drawn


def single(effect):
    return lambda rng, top: {effect: draw(rng, effect, top)}


def diagnose(record, **kinds):
    return diagnose_joints([record], {record.joint: NOMINAL}, **kinds)


def test_simulation_matches_fine_steps():
    truths = [
        {"lag": 0.05, "acceleration_limit": 8.0},
        {"lag": 0.05, "backlash": 0.02, "coulomb_friction": 0.1},
        {"acceleration_limit": 8.0, "backlash": 0.02, "velocity_gain": 0.9, "joint_offset": 0.1},
        {"lag": 0.03, "acceleration_limit": 10.0, "backlash": 0.02, "deadband": 0.2, "velocity_limit": 1.0},
        {"servo": 0.02, "servo_gain": 0.97},
        {"servo": 0.02, "lag": 0.02},
        {"servo": 0.008, "lag": 0.05, "acceleration_limit": 8.0, "backlash": 0.02},
        {"servo": 0.02, "acceleration_limit": 8.0, "backlash": 0.02},
    ]
    rng = np.random.default_rng(0)
    times, commands = zip(*(command(rng, 8.0, KINDS[i % 4], 2.0) for i in range(len(truths))), strict=True)
    queries = [np.sort(rng.uniform(0.0, 8.0, 500)) for _ in truths]
    for t, u, q, truth, path in zip(
        times, commands, queries, truths, euler(times, commands, queries, truths), strict=True
    ):
        response = JointResponse(action_delay=0.06, observation_delay=0.04, **truth)
        # Euler's own error is about DT / 2 times the speed.
        np.testing.assert_allclose(response.simulate(t, u, q), path, atol=5e-4)


def test_lag_and_ramp_have_their_closed_forms():
    t, u, q = np.array([0.0]), np.array([2.0]), np.linspace(0.0, 3.0, 50)
    lagged = JointResponse(lag=0.4).simulate(t, u, q, 1.0)
    np.testing.assert_allclose(lagged, 1.0 + 2.0 * (q - 0.4 * (1 - np.exp(-q / 0.4))), atol=1e-12)
    ramped = JointResponse(acceleration_limit=2.0).simulate(t, u, q)
    np.testing.assert_allclose(ramped, np.where(q < 1.0, q * q, 1.0 + 2.0 * (q - 1.0)), atol=1e-12)


@pytest.fixture(scope="module")
def singles():
    return cases(21, [single(effect) for effect in EFFECTS], 24.0)


@pytest.mark.parametrize("i", range(len(EFFECTS)), ids=EFFECTS)
def test_names_a_single_effect_with_its_size(singles, i):
    record, truth = singles[0][i], singles[1][i]
    findings = diagnose(record)
    name = {"delay": "action_delay"}.get(EFFECTS[i], EFFECTS[i])
    assert [cause.name for cause in findings.causes] == [f"joint_2.{name}"]
    cause = findings.causes[0]
    assert findings.unexplained is None and cause.confidence > 0.9
    estimates = {n.removeprefix("joint_2."): e.estimate for n, e in cause.parameters.items()}
    if name == "action_delay":
        assert cause.group == ("joint_2.action_delay", "joint_2.observation_delay")
        total = estimates["action_delay"] + estimates.get("observation_delay", NOMINAL.observation_delay)
        assert total == pytest.approx(truth["delay"], abs=0.002)
        assert "joint_2.observation_delay" in [u.name for u in findings.not_identifiable]
    else:
        assert estimates[name] == pytest.approx(truth[name], rel=0.08)
    nominal, estimate, low, high, unit = astuple(cause.parameters[f"joint_2.{name}"])
    assert low <= estimate <= high and nominal == getattr(NOMINAL, name) and unit
    gain = findings.held_out[0]
    assert gain.low > 0.0 and gain.after < 0.7 * gain.before
    assert getattr(findings.responses["joint_2"], name) == estimate


def test_names_nothing_when_the_model_is_right():
    records, _ = cases(5, [lambda rng, top: {}] * 8, 24.0)
    for record in records:
        findings = diagnose(record)
        assert findings.causes == () and findings.unexplained is None
        assert findings.responses["joint_2"] == NOMINAL
        assert findings.held_out[0].before == findings.held_out[0].after


def stronger_one_way(time, v, q, target, a):
    return np.where(v > 0.0, -0.06 * v, 0.0)


def test_calls_an_effect_outside_the_catalogue_unexplained():
    records, _ = cases(9, [lambda rng, top: {}] * 2, 24.0, stronger_one_way, kinds=("sines", "steps"))
    for record in records:
        findings = diagnose(record)
        assert findings.causes == ()
        assert findings.unexplained.joint == "joint_2" and "velocity" in findings.unexplained.block
        assert findings.unexplained.size > 1.0  # mrad


@cache
def slow(seed=0, joint="joint_2", one_way=False, **truth):
    """A log of smooth, slow motion."""
    rng = np.random.default_rng(seed)
    t = np.round(np.arange(0.0, 16.0, 1 / 75) / DT) * DT
    u = np.where(t < 0.5, 0.0, 0.05 if one_way else 0.4 * np.sin(2 * np.pi * 0.8 * (t - 0.5)))
    q = np.arange(0.0, 16.0, 1 / 125)
    (path,) = euler([t], [u], [q], [truth])
    return JointRecord(joint, t, u, q, path + rng.normal(0, 2e-4, q.size))


def test_says_what_the_log_does_not_excite():
    said = {u.name for u in diagnose(slow()).not_excited}
    assert {"joint_2.velocity_limit", "joint_2.acceleration_limit"} <= said
    assert not said & {"joint_2.backlash", "joint_2.action_delay", "joint_2.observation_delay", "joint_2.velocity_gain"}
    findings = diagnose(slow(one_way=True))
    assert "joint_2.backlash" in {u.name for u in findings.not_excited}
    assert any("joint_2" in text and "rad/s" in text for text in findings.next_experiment)
    moved = slow()
    rest = 0 * moved.command_velocity, moved.state_time, 0 * moved.state_position
    findings = diagnose(JointRecord("joint_2", moved.command_time, *rest))
    assert findings.causes == () and len(findings.not_excited) == 9  # all but the offset
    limited = diagnose(slow(velocity_limit=0.45))  # above the largest command
    assert limited.causes == () and "joint_2.velocity_limit" in {u.name for u in limited.not_excited}


def test_an_offset_needs_the_home_position():
    record = slow(joint_offset=0.004)
    findings = diagnose(record)
    assert findings.causes == () and "joint_2.joint_offset" in [u.name for u in findings.not_identifiable]
    (cause,) = diagnose(record, home={"joint_2": 0.0}).causes
    nominal, estimate, low, high, unit = astuple(cause.parameters["joint_2.joint_offset"])
    assert cause.name == "joint_2.joint_offset" and low <= 0.004 <= high and (nominal, unit) == (0.0, "rad")
    assert diagnose(slow(), home={"joint_2": 0.0}).causes == ()
    left_out = diagnose(record, home={"joint_2": 0.0}, without=["joint_offset"])
    assert left_out.causes == () and "home" in left_out.unexplained.block


def rows(time, values):
    return [f"{t!r},joint_2,{x!r}" for t, x in zip(time.tolist(), values.tolist(), strict=True)]


def write(folder, command_rows, state_rows, header="t,joint,velocity"):
    (folder / "command.csv").write_text("\n".join([header, *command_rows]) + "\n")
    (folder / "state.csv").write_text("\n".join(["t,joint,position", *state_rows]) + "\n")


def test_reads_a_pair_of_files_and_names_what_is_wrong(tmp_path):
    record = slow()
    commands = rows(record.command_time, record.command_velocity)
    states = rows(record.state_time, record.state_position)
    write(tmp_path, commands, states)
    files = tmp_path / "command.csv", tmp_path / "state.csv"
    (read,) = read_robot_csv(*files)
    np.testing.assert_array_equal(read.state_position, record.state_position)
    np.testing.assert_array_equal(read.command_time, record.command_time)
    degrees = rows(record.state_time, np.degrees(record.state_position))
    for bad_commands, bad_states, message in (
        (commands, [s.replace("joint_2", "joint_9") for s in states], "state.csv:2: no joint 'joint_9'; .* gantry_x"),
        (commands, [s.replace("joint_2", "joint_3") for s in states], "state.csv: no row of joint_2"),
        (commands, states[:50] + states[40:], "joint_2: time must increase, state 50"),
        (commands, degrees, "degrees"),
    ):
        write(tmp_path, bad_commands, bad_states)
        with pytest.raises(ValueError, match=message):
            read_robot_csv(*files)


def test_a_joint_that_stays_open_takes_no_others_cause_with_it():
    def cause(joint, lag):
        name = f"{joint}.lag"
        return Cause(name, (name,), 1.0, {name: Estimate(0.0, lag, lag, lag, "s")}, 3.0, "")

    left = (JointFinding("joint_3", "dynamics", "after 0.04 s", "-", 0.6), JointFinding("joint_5", "x", "y", "-", 0.9))
    found = JointFindings(causes=(cause("joint_2", 0.02), cause("joint_3", 0.01)), unexplained_by_joint=left)
    verdict, values, _ = combined(parts(found))
    assert verdict.verdict == "unexplained" and values == {"drives.joint_2.lag": 0.02}
    assert {c.name for c in verdict.causes} == {"joint_2.lag", "joint_3.lag"}
    assert verdict.unexplained.block.startswith("joint_3") and NOT_ADOPTED in verdict.warnings
