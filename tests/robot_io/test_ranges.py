"""Ranges of numbers in configurations."""

from __future__ import annotations

import pytest

from robot_io.emulator.config import RigParams
from robot_io.ranges import check_ranges, outside


@pytest.mark.parametrize("path, missing", [("trackr.rate", "trackr"), ("tracker.cameras.focal_length", "focal_length")])
def test_a_path_that_leads_nowhere_is_refused(path, missing):
    with pytest.raises(AttributeError, match=missing):
        check_ranges(RigParams(), {path: (0, 1)})


def test_files_may_omit_what_they_like():
    assert not list(outside({"tracker": None, "seed": 5}, {"tracker.cameras.focal": (0, 1), "seed": (0, 9)}))
