"""Joint diagnosis against the examination's joints, which know nothing of it: fine steps of a drive as it is worded."""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest

from mjx_tt.diagnosis.joint import (
    JointFinding,
    JointFindings,
    JointGain,
    JointRecord,
    JointResponse,
    diagnose_joints,
    read_robot_csv,
)
from mjx_tt.diagnosis.joint.diagnose import parts
from mjx_tt.diagnosis.verdict import NOT_ADOPTED, Cause, Estimate, combined
from tests.exam.generator import robot

TRUE = robot.Joint()
NOMINAL = JointResponse(action_delay=TRUE.action_delay, observation_delay=TRUE.observation_delay)
SIZES = {
    "action_delay": 0.09,  # 19 ms more, which a lag of 19 ms explains nearly as well
    "lag": 0.04,
    "velocity_gain": 0.92,
    "velocity_limit": 1.2,
    "acceleration_limit": 20.0,
    "backlash": 0.008,
    "coulomb_friction": 0.06,
    "deadband": 0.15,
}


def record(joint=TRUE, seed=0, slow=0.0, one_way=False) -> JointRecord:
    """A log of strokes, or of smooth and slow motion up to a speed [rad/s], with noise of 0.2 mrad."""
    rng = np.random.default_rng(seed)
    time, velocity = robot.commands(rng, 16.0 if slow else 30.0)
    u = velocity[robot.JOINTS.index("joint_2")]
    if slow:
        u = np.where(time < 0.5, 0.0, slow * (1.0 if one_way else np.sin(2 * np.pi * 0.8 * (time - 0.5))))
    query = np.arange(0.0, time[-1], 1 / 125) + rng.uniform(0, 0.008)
    position = robot.respond(joint, time, u, query) + rng.normal(0, 2e-4, query.size)
    return JointRecord("joint_2", time, u, query, position)


def diagnose(log, **kinds):
    return diagnose_joints([log], {log.joint: NOMINAL}, **kinds)


@pytest.mark.parametrize(
    "truth",
    [
        {"lag": 0.05, "acceleration_limit": 8.0},
        {"lag": 0.05, "backlash": 0.02, "coulomb_friction": 0.1},
        {"acceleration_limit": 8.0, "backlash": 0.02, "velocity_gain": 0.9, "joint_offset": 0.1},
        {"lag": 0.03, "acceleration_limit": 10.0, "backlash": 0.02, "deadband": 0.2, "velocity_limit": 1.0},
    ],
)
def test_simulation_matches_fine_steps(truth):
    log = record()
    path = robot.respond(replace(TRUE, **truth), log.command_time, log.command_velocity, log.state_time)
    found = replace(NOMINAL, **truth).simulate(log.command_time, log.command_velocity, log.state_time)
    np.testing.assert_allclose(found, path, atol=6e-4)  # of steps of 0.2 ms at up to 2 rad/s


def test_lag_ramp_and_servo_have_their_closed_forms():
    t, u, q = np.array([0.0]), np.array([2.0]), np.linspace(0.0, 3.0, 50)
    lagged = JointResponse(lag=0.4).simulate(t, u, q, 1.0)
    np.testing.assert_allclose(lagged, 1.0 + 2.0 * (q - 0.4 * (1 - np.exp(-q / 0.4))), atol=1e-12)
    ramped = JointResponse(acceleration_limit=2.0).simulate(t, u, q)
    np.testing.assert_allclose(ramped, np.where(q < 1.0, q * q, 1.0 + 2.0 * (q - 1.0)), atol=1e-12)
    served = JointResponse(servo=0.4, servo_gain=0.97).simulate(t, u, q)
    np.testing.assert_allclose(served, 0.97 * 2.0 * (q - 0.4 * (1 - np.exp(-q / 0.4))), atol=1e-6)


@pytest.mark.parametrize("name", SIZES)
def test_names_a_single_effect_with_its_size(name):
    findings = diagnose(record(replace(TRUE, **{name: SIZES[name]}), seed=21))
    (cause,) = findings.causes
    assert cause.name == f"joint_2.{name}" and findings.unexplained is None and cause.confidence > 0.9
    estimates = {n.removeprefix("joint_2."): e.estimate for n, e in cause.parameters.items()}
    if name == "action_delay":
        assert cause.group == ("joint_2.action_delay", "joint_2.observation_delay")
        total = estimates["action_delay"] + estimates.get("observation_delay", NOMINAL.observation_delay)
        assert total == pytest.approx(SIZES[name] + TRUE.observation_delay, abs=0.002)
        assert "joint_2.observation_delay" in [u.name for u in findings.not_identifiable]
    else:
        assert estimates[name] == pytest.approx(SIZES[name], rel=0.08)
    nominal, estimate, low, high, unit = astuple(cause.parameters[f"joint_2.{name}"])
    assert low <= estimate <= high and nominal == getattr(NOMINAL, name) and unit
    gain = findings.held_out[0]
    assert gain.low > 0.0 and gain.after < 0.7 * gain.before
    assert getattr(findings.responses["joint_2"], name) == estimate


@pytest.mark.parametrize("seed", range(4))
def test_names_nothing_when_the_model_is_right(seed):
    findings = diagnose(record(seed=seed))
    assert findings.causes == () and findings.unexplained is None
    assert findings.responses["joint_2"] == NOMINAL
    assert findings.held_out[0].before == findings.held_out[0].after


@pytest.mark.parametrize("seed", range(3))
def test_calls_an_effect_outside_the_catalogue_unexplained(seed):
    """A drive that loses some of its way in one direction only."""
    log = record(seed=seed)
    lost = 0.06 * np.cumsum(np.maximum(np.diff(log.state_position, prepend=0.0), 0.0))
    findings = diagnose(replace(log, state_position=log.state_position - lost))
    assert findings.causes == ()
    assert findings.unexplained.joint == "joint_2" and "velocity" in findings.unexplained.block
    assert findings.unexplained.size > 1.0  # mrad


def test_says_what_the_log_does_not_excite():
    said = {u.name for u in diagnose(record(slow=0.4)).not_excited}
    assert {"joint_2.velocity_limit", "joint_2.acceleration_limit"} <= said
    assert not said & {"joint_2.backlash", "joint_2.action_delay", "joint_2.observation_delay", "joint_2.velocity_gain"}
    findings = diagnose(record(slow=0.05, one_way=True))
    assert "joint_2.backlash" in {u.name for u in findings.not_excited}
    assert any("joint_2" in text and "rad/s" in text for text in findings.next_experiment)
    limited = diagnose(record(replace(TRUE, velocity_limit=0.45), slow=0.4))  # above the largest command
    assert limited.causes == () and "joint_2.velocity_limit" in {u.name for u in limited.not_excited}


def test_an_offset_needs_the_home_position():
    log = record(replace(TRUE, joint_offset=0.004), slow=0.4)
    findings = diagnose(log)
    assert findings.causes == () and "joint_2.joint_offset" in [u.name for u in findings.not_identifiable]
    (cause,) = diagnose(log, home={"joint_2": 0.0}).causes
    nominal, _, low, high, unit = astuple(cause.parameters["joint_2.joint_offset"])
    assert cause.name == "joint_2.joint_offset" and low <= 0.004 <= high and (nominal, unit) == (0.0, "rad")
    assert diagnose(record(slow=0.4), home={"joint_2": 0.0}).causes == ()


def rows(time, values):
    return [f"{t!r},joint_2,{x!r}" for t, x in zip(time.tolist(), values.tolist(), strict=True)]


def test_reads_a_pair_of_files_and_names_what_is_wrong(tmp_path):
    log = record(slow=0.4)
    commands, states = rows(log.command_time, log.command_velocity), rows(log.state_time, log.state_position)
    degrees = rows(log.state_time, np.degrees(log.state_position))
    files = tmp_path / "command.csv", tmp_path / "state.csv"
    files[0].write_text("\n".join(["t,joint,velocity", *commands]))

    def read(lines):
        files[1].write_text("\n".join(["t,joint,position", *lines]))
        return read_robot_csv(*files)

    (found,) = read([f"{float(log.state_time[0]) - 0.01!r},joint_2,nan", *states])  # it had not reported yet
    np.testing.assert_array_equal(found.state_position, log.state_position)
    np.testing.assert_array_equal(found.command_time, log.command_time)
    for bad, message in (
        ([s.replace("joint_2", "joint_9") for s in states], "state.csv:2: no joint 'joint_9'; .* gantry_x"),
        ([s.replace("joint_2", "joint_3") for s in states], "state.csv: no row of joint_2"),
        (states[:50] + states[40:], "joint_2: time must increase, state 50"),
        (degrees, "degrees"),
    ):
        with pytest.raises(ValueError, match=message):
            read(bad)


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
    better = JointGain("joint_3", before=2e-3, after=1e-3, low=5e-4, high=1.5e-3)
    assert combined(parts(replace(found, held_out=(better,))))[1] == {
        "drives.joint_2.lag": 0.02,
        "drives.joint_3.lag": 0.01,
    }
