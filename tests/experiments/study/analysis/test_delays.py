"""One clock of five delays shows nowhere: sums and differences by hand, and a robot in which nothing changes."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.study.analysis import delays
from experiments.study.analysis.identified import LOGS, PRIOR_ALONE, holds, list_estimates
from experiments.study.analysis.identified import PRIOR as DRAWN
from mjx_tt.sim import model as models
from mjx_tt.sim.model import ModelFile, Samples, SimModel

RANGES = {
    delays.ARM: (0.02, 0.04),
    delays.AXES: (0.01, 0.05),
    delays.BALL: (0.03, 0.05),
    delays.AXES_COMMAND: (0.0, 0.1),
}
TRUTH = {
    delays.ARM: 0.020,
    delays.AXES: 0.045,
    delays.BALL: 0.050,
    "latency.abb_action": 0.060,
    delays.AXES_COMMAND: 0.040,
}


def test_a_later_clock_of_all_that_moves_is_no_other_reality():
    """Measurements 7 ms later, commands 7 ms sooner: the same robot for whoever sees and commands it."""
    later = {path: value + (0.007 if "observation" in path else -0.007) for path, value in TRUTH.items()}
    world = models.paths() | {delays.ARM: 0.029, delays.AXES: 0.035}
    one, other = (delays.add_to_sums(models.paths() | x, world) for x in (TRUTH, later))
    assert one == pytest.approx(other, abs=1e-12)
    # By hand: the arm is measured 9 ms sooner than believed, and 25 ms sooner than the axes.
    assert one[delays.ARM] == 0.029 and one[delays.AXES] == pytest.approx(0.029 + 0.025)
    assert one[delays.BALL] == pytest.approx(0.029 + 0.030) and one["latency.abb_action"] == pytest.approx(0.051)
    assert one[delays.AXES_COMMAND] == pytest.approx(0.040 + 0.045 - 0.035)


def test_ball_and_axes_are_as_open_against_the_arm_as_both_ranges_let_them_be():
    known = delays.compute_moments(RANGES, 0.029)
    assert known[delays.AXES_COMMAND] == pytest.approx((0.05, 0.1 / 12**0.5))
    assert known[delays.BALL] == pytest.approx((0.039, (2 * 0.02**2 / 12) ** 0.5))
    assert known[delays.AXES] == pytest.approx((0.029, ((0.02**2 + 0.04**2) / 12) ** 0.5))
    ends = delays.shift_to_arm(RANGES, 0.029)
    assert ends[delays.BALL] == pytest.approx((0.019, 0.059)) and ends[delays.AXES] == pytest.approx((0.0, 0.059))
    drawn = delays.draw_unseen(RANGES, 0.029, (delays.AXES, delays.BALL), 20_000)
    assert drawn.values.min() >= 0.0
    np.testing.assert_allclose(drawn.values.mean(axis=0), [0.029, 0.039], atol=0.001)
    # Both are against the same arm: of the variances 0.04^2 + 0.02^2 and 2 x 0.02^2 they share 0.02^2.
    assert np.corrcoef(drawn.values.T)[0, 1] == pytest.approx(1.0 / (5.0 * 2.0) ** 0.5, abs=0.03)


def test_the_axes_command_goes_against_their_measurement_row_by_row():
    rng = np.random.default_rng(0)
    seen, told = rng.uniform(0.02, 0.05, 100), rng.normal(0.051, 0.0005, 100)
    values = np.stack([told, rng.uniform(size=100), seen], axis=1)
    samples = Samples((delays.AXES_COMMAND, "ball.table.friction", delays.AXES), values, np.ones(100))
    summed = delays.shift_command(samples, 0.033)
    np.testing.assert_allclose(summed.values[:, 0] + seen, told + 0.033)
    np.testing.assert_array_equal(summed.values[:, 1:], values[:, 1:])
    np.testing.assert_allclose(delays.restore_command(summed, 0.033).values, values)
    assert delays.shift_command(Samples((delays.AXES,), seen[:, None], np.ones(100)), 0.033).paths == (delays.AXES,)


def test_a_report_judges_the_sum_and_says_what_the_prior_alone_drew():
    """The sum is known within half a millisecond; the measurement alone is any from 20 to 50 ms."""
    rng = np.random.default_rng(0)
    seen, told = rng.uniform(0.02, 0.05, 200), rng.normal(0.051, 0.0005, 200)
    values = np.stack([told + 0.033 - seen, seen], axis=1)
    centre = dict(zip((delays.AXES_COMMAND, delays.AXES), values.mean(axis=0).tolist(), strict=True))
    made_of = {"identified": {PRIOR_ALONE: [delays.AXES]}}
    samples = Samples((delays.AXES_COMMAND, delays.AXES), values, np.ones(200))
    world = ModelFile(models.with_values(SimModel(), centre), (samples,), made_of)
    rows = {row["parameter"]: row for row in list_estimates(world, {delays.AXES: 0.022, delays.AXES_COMMAND: 0.062})}
    sums = rows[delays.AXES_COMMAND]
    assert sums["high"] - sums["low"] < 0.0025 and holds(sums) and sums["decided by"] == LOGS
    assert sums["truth"] == pytest.approx(0.022 + 0.062 - centre[delays.AXES])
    assert rows[delays.AXES]["decided by"] == DRAWN and rows[delays.AXES]["truth"] == 0.022
