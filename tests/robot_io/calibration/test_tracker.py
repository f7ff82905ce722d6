"""Camera to table, against hidden errors that are written in other angles than the solver's."""

from __future__ import annotations

import numpy as np
import pytest

from robot_io.calibration import points, tracker
from tests.support.hidden_rig import HIDDEN, grid

CORNERS = np.array([[x, y, z] for x in (-0.76, 0.76) for y in (-1.37, 1.37) for z in (0.0, 0.3)])


def worst(fit, hidden=HIDDEN):
    """[m] anywhere over the table."""
    return max(np.linalg.norm(fit.calibration.outward(hidden.seen(p)) - p) for p in CORNERS)


@pytest.mark.parametrize("seed", range(5))
def test_hidden_frame_is_found_within_2_mm_and_2_mrad(seed):
    fit = tracker.fit(*grid(seed=seed), "2026-11-22")
    assert fit.used.all() and worst(fit) < 0.002
    turned = fit.calibration.matrix @ np.stack([HIDDEN.seen(e) - HIDDEN.seen(np.zeros(3)) for e in np.eye(3)], axis=1)
    assert np.arccos((np.trace(turned) - 1) / 2) < 0.002
    assert 0.0002 < fit.calibration.residual < 0.002  # half a millimetre of tape measure in each coordinate


def test_noise_that_is_not_gaussian_and_wrong_points_bend_nothing():
    """Broken on purpose: heavy tails (Student's t, 1.5 degrees of freedom), a ball 8 cm off, x and y exchanged."""
    random = np.random.default_rng(7)
    table, seen = grid(spread=lambda shape: random.standard_t(1.5, shape))
    seen[4] += [0.06, 0.05, 0.0]
    seen[9, :2] = seen[9, 1::-1]
    fit = tracker.fit(table, seen, "2026-11-22")
    assert not fit.used[[4, 9]].any() and fit.used.sum() >= 8 and worst(fit) < 0.004


def test_deviations_are_those_of_repeated_measurements():
    fits = [tracker.fit(*grid(seed=seed), "2026-11-22") for seed in range(40)]
    turns = np.std([f.calibration.rotation for f in fits], axis=0)
    np.testing.assert_allclose(turns, np.mean([f.deviation[3:] for f in fits], axis=0), rtol=0.4)


def test_points_that_cannot_tell_are_refused():
    table, seen = grid()
    with pytest.raises(ValueError, match="4 points .* at least 5"):
        tracker.fit(table[:4], seen[:4], "2026-11-22")
    line = np.linspace(0, 1, 9)[:, None] * [0.3, 1.0, 0.0]
    with pytest.raises(ValueError, match="on one line"):
        tracker.fit(line, line, "2026-11-22")
    with pytest.raises(ValueError, match="no rigid motion fits"):
        tracker.fit(table, np.random.default_rng(0).uniform(-1, 1, seen.shape), "2026-11-22")


@pytest.mark.parametrize("mirror", [(-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, -1)])
def test_a_mirrored_frame_is_refused(mirror):
    """With points on a stand it is told; without them nothing can tell, whichever the frame is."""
    table, seen = grid()
    with pytest.raises(ValueError, match="mirror image of the table's: so 15 of 15 points"):
        tracker.fit(table, seen * mirror, "2026-11-22")
    flat = table[:, 2] < 0.1
    for frame in (seen, seen * mirror):
        with pytest.raises(ValueError, match="in one plane, .* on a stand"):
            tracker.fit(table[flat], frame[flat], "2026-11-22")


def test_one_point_on_a_low_stand_tells():
    few = [*range(12), 13]
    low, there = (points[few] for points in grid())
    low[-1, 2] -= 0.2
    there[-1, 2] -= 0.2  # the hidden frame is turned by less than 10 mrad
    assert tracker.fit(low, there, "2026-11-22").used.all()
    with pytest.raises(ValueError, match="mirror"):
        tracker.fit(low, there * [1, 1, -1], "2026-11-22")


def test_csv_errors_name_file_line_and_column(tmp_path):
    path = tmp_path / "ball.csv"
    path.write_text("table_x,table_y,table_z,ball_x,ball_y,ball_z\n0,0,0.02,1,2,x\n")
    with pytest.raises(ValueError, match=r"ball.csv: line 2: ball_z is 'x'"):
        points.read(path, points.TABLE, points.BALL)
    path.write_text("table_x,ball_x\n0,0\n")
    with pytest.raises(ValueError, match=r"ball.csv: no columns table_y, table_z, ball_y, ball_z; found: table_x"):
        points.read(path, points.TABLE, points.BALL)
    path.write_text("table_x,table_y,table_z,ball_x,ball_y,ball_z,note\n,,,1,2,3,not measured\n1,2,3,4,5,6,\n")
    lines, (table, seen) = points.read(path, points.TABLE, points.BALL)
    assert lines == [3] and table.tolist() == [[1, 2, 3]] and seen.tolist() == [[4, 5, 6]]
