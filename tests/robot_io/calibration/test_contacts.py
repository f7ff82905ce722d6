"""Contacts in a log that was made up."""

from __future__ import annotations

import numpy as np
import pytest

from robot_io.calibrated import UNCALIBRATED, Calibration, RobotCalibration
from robot_io.calibration import contacts
from tests.support.contact_log import made_up


@pytest.mark.parametrize("lag", [0.0, 0.029, 0.045])
def test_lag_of_the_joints_is_found(lag):
    found = contacts.measure(made_up(lag), UNCALIBRATED)
    assert found.count >= 25 and found.lag == pytest.approx(lag, abs=3 * found.lag_deviation)
    assert found.lag_deviation < 0.002 and found.spread < 0.006


def test_a_base_that_is_not_where_it_is_said_to_be_looks_like_another_lag():
    """One number cannot tell 12 mm from a lag of 12 mm over the blade's speed."""
    log = made_up(0.03, gap=0.012)
    wrong = contacts.measure(log, UNCALIBRATED)
    assert abs(wrong.lag - 0.03) > 0.004
    moved = Calibration(robot=RobotCalibration((0.0, 0.012, 0.0), date="2026-11-22"))
    right = contacts.measure(log, moved)
    assert right.lag == pytest.approx(0.03, abs=3 * right.lag_deviation + 0.001)


def test_too_few_contacts_tell_nothing():
    found = contacts.measure(made_up(0.03, count=5), UNCALIBRATED)
    assert found.count == 5 and np.isnan(found.lag)
