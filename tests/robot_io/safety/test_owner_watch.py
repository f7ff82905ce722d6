"""The owner's silence, and the time in which nobody could have been heard."""

from __future__ import annotations

import numpy as np
import pytest

from robot_io.safety.owner_watch import LONGEST_ABSENCE, LONGEST_SILENCE, OwnerWatch


def lasts(watch, begin=0.0, end=100.0):
    """Seconds of ticks until the watch gives a reason."""
    for now in np.arange(begin, end, 1 / 75):
        if watch.ticked(now):
            return now - begin
    return end - begin


@pytest.mark.parametrize(
    ("absence", "allowed"),
    [(0.0, LONGEST_SILENCE), (-1.0, LONGEST_SILENCE), (10.0, 10.0), (1e9, LONGEST_ABSENCE)],
)
def test_silence_is_allowed_for_so_long(absence, allowed):
    watch = OwnerWatch()
    watch.heard(absence)
    assert lasts(watch) == pytest.approx(allowed, abs=0.05)
    watch.heard()
    assert lasts(watch, 200.0, 300.0) == pytest.approx(LONGEST_SILENCE, abs=0.2)


def test_a_process_that_stood_still_does_not_blame_its_owner():
    watch = OwnerWatch()
    watch.heard()
    assert not watch.ticked(0.0) and not watch.ticked(5.0) and not watch.ticked(5.1)
