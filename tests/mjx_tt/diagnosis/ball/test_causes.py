"""Causes that unseen balls refute."""

from __future__ import annotations

import pytest

from mjx_tt.diagnosis.ball.causes import refuted
from mjx_tt.diagnosis.verdict import HeldOut


@pytest.mark.parametrize(
    ("sizes", "low", "high", "expected"),
    [
        ([15.0, 9.0], -0.1, 0.05, True),  # larger than the error, and nothing gained
        ([15.0, 9.0], 0.5, 3.0, False),
        ([9.0, 9.0], -0.1, 0.05, False),  # within what unseen balls are missed by: too small to be seen there
        ([15.0, 9.0], -0.1, 0.5, False),  # few balls: a gain is not excluded
        ([], -0.1, 0.05, False),
    ],
)
def test_causes_larger_than_the_error_on_unseen_balls_must_gain_there(sizes, low, high, expected):
    assert refuted(sizes, HeldOut("rms [mm]", 14.0, 14.0, low, high)) is expected
