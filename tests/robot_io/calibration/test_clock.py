"""Clock's calibration from what the bridge logged."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from robot_io.calibrated import UNCALIBRATED
from robot_io.calibration import clock
from tests.support.contact_log import made_up


def logged(seconds, contacts=30):
    """The tracker fell silent at the end, as one does that is switched off."""
    report = {"offset": -3.2, "at": 100.0, "drift": -4e-5, "residual": 1e-5, "seconds": seconds}
    events = [SimpleNamespace(name="clock", text=json.dumps(report | {"drift": 0.0})), SimpleNamespace(name="state")]
    for found in (report, report | {"drift": 0.0, "seconds": 0}):
        events.append(SimpleNamespace(name="clock", text=json.dumps(found)))
    return SimpleNamespace(events=events, **vars(made_up(0.031, count=contacts)))


def test_drift_is_the_one_of_most_seconds_and_lag_that_of_the_contacts():
    found, told = clock.fit(logged(60), UNCALIBRATED, "2026-11-22")
    assert found.drift == -4e-5 and found.lag == pytest.approx(0.031, abs=0.004) and found.date == "2026-11-22"
    assert "offset -3.200000 s" in told[0] and "-40.00 ppm" in told[0]
    few, told = clock.fit(logged(60, contacts=4), UNCALIBRATED, "2026-11-22")
    assert few.lag is None and "4 contacts with the paddle: too few" in told[1]


def test_a_short_session_is_refused():
    with pytest.raises(ValueError, match="15 s of the tracker's frames in one go; at least 20"):
        clock.fit(logged(15), UNCALIBRATED, "2026-11-22")
    empty = SimpleNamespace(events=[], ball=SimpleNamespace(id=np.zeros(0)))
    with pytest.raises(ValueError, match="0 s of"):
        clock.fit(empty, UNCALIBRATED, "2026-11-22")
