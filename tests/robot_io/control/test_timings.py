"""Percentiles of durations against NumPy's."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot_io.control.timings import Timing, Timings


@pytest.mark.parametrize("spread", [0.3, 3.0])
def test_percentiles_are_numpys_to_the_width_of_a_bin(spread):
    samples = np.random.default_rng(0).lognormal(math.log(1e-4), spread, 50_000)
    samples = np.clip(samples, 2e-7, 50.0)
    timing = Timing()
    for sample in samples.tolist():
        timing.add(sample)
    for share in (1, 50, 99, 99.9, 99.99):
        exact = np.percentile(samples, share, method="inverted_cdf")
        assert exact <= timing.percentile(share) * (1 + 1e-9) and timing.percentile(share) <= exact * 10 ** (1 / 200)
    assert timing.count == 50_000 and timing.max == samples.max() and timing.percentile(100) == timing.max


def test_extremes_and_nothing():
    timing = Timing()
    assert math.isnan(timing.percentile(50)) and Timings().summary() == {"missed_ticks": 0}
    for sample in (-1e-3, 0.0, 1e-9, 1e4):
        timing.add(sample)
    assert timing.percentile(50) == 0.0 and timing.percentile(100) <= timing.max == 1e4
    timings = Timings()
    timings.reply.add(0.002)
    assert timings.summary()["reply"] == {"p50_ms": 2.0, "p99_ms": 2.0, "p99.9_ms": 2.0, "max_ms": 2.0, "count": 1}
