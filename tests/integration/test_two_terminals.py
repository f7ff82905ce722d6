"""The operator's terminal and the rig's, as two people sit at them: keys on both, and what the log says afterwards."""

from __future__ import annotations

import json

import numpy as np
import pytest

from robot_io import contract, log
from robot_io.policy import export
from robot_io.policy.policy import Policy
from tests.support.terminal import Terminal

RESET, ARMED_AGAIN = ("disarmed", "fault reset by the operator"), ("ready", "armed by the operator")
ARMED, FAULT, DISARMED = r"\b(READY|ACTIVE)\b", r"\bFAULT\b", r"\bDISARMED\b"


def done(rig, key, deed):
    rig.press(key)
    rig.wait(f"{deed};")


@pytest.fixture
def terminals(tmp_path):
    """Of the operator, after the first ball, and of the rig, which throws more."""
    artefact = tmp_path / "artefact"
    theta = 0.05 * np.random.default_rng(0).standard_normal(contract.n_parameters())
    export.write(artefact, Policy(theta, np.zeros(contract.N_OBSERVATION), np.ones(contract.N_OBSERVATION)), {})
    robot = tmp_path / "robot.yaml"
    with Terminal("rig", "--out", str(robot)) as rig:
        rig.wait("the rig runs")
        arguments = ("run", str(artefact), "--robot", str(robot), "--backend", "numpy", "--log", str(tmp_path / "log"))
        with Terminal(*arguments) as operator:
            operator.wait(DISARMED)
            done(rig, "o", "switch the arm on")
            done(rig, "b", "throw balls, or stop")
            operator.press("p")
            operator.wait(r"DISARMED\s+balls")  # nothing that it waits for between them
            operator.press("a")
            operator.wait(r"balls [1-9]")
            yield operator, rig, tmp_path / "log"


def after_the_fault(operator, folder):
    """States of the session, which the operator quits, from its first fault on, each with its reason."""
    operator.press("q")
    assert operator.ended() == 0, operator.read(0.0)
    (path,) = folder.glob("*.mcap")
    session = log.read(path)
    assert np.abs(session.commands.sent).max() > 0 and not session.commands.sent[:, -1].any()
    found = [(text["to"], text["why"]) for text in (json.loads(e.text) for e in session.events if e.name == "state")]
    return found[next(i for i, (_, why) in enumerate(found) if why.startswith("fault: ")) :]


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(
    ("breaks", "mends"),
    [
        (("c", "axis.s cable"), ("c", "axis.s cable")),
        (("e", "emergency stop"), ("o", "switch the arm on")),
        (("f", "drive fault"), None),
    ],
    ids=["cable", "emergency stop", "drive"],
)
def test_what_a_hand_mends_at_the_robot_is_followed_by_no_motion(terminals, breaks, mends):
    """A pulled cable, an emergency stop, a drive's fault: ``c`` resets once it is mended, and asks for ``a``."""
    operator, rig, folder = terminals
    done(rig, *breaks)
    operator.wait(FAULT)
    operator.press("c")
    if mends is not None:
        assert "press a to arm" not in operator.read(1.0)
        done(rig, *mends)
    operator.wait("all is well: press a to arm")
    operator.press("d")  # forgets what was shown
    assert "READY" not in operator.read(1.0) and "ACTIVE" not in operator.read(0.0)
    operator.press("a")
    operator.wait(ARMED)
    states = after_the_fault(operator, folder)
    i = states.index(RESET)
    assert {state for state, _ in states[:i]} <= {"stopping", "disarmed"} and states[i + 1] == ARMED_AGAIN, states


@pytest.mark.slow
@pytest.mark.realtime
def test_a_fault_that_is_over_is_left_by_one_key(terminals):
    """The tracker was silent for a second and is heard again: nobody has to mend anything."""
    operator, rig, folder = terminals
    done(rig, "t", "tracker silent for 1 s")
    operator.wait(FAULT)
    operator.read(1.5)
    operator.press("c")
    operator.wait(ARMED)
    states = after_the_fault(operator, folder)
    i = states.index(RESET)
    assert {state for state, _ in states[:i]} <= {"stopping", "disarmed"} and states[i + 1] == ARMED_AGAIN, states
