"""The detector's arithmetic against closed forms, and its manners; what it finds is tested with its weights."""

import numpy as np
import pytest

from robot_io.vision import detector as module
from robot_io.vision.detector import AROUND, CELL, FAR_CELL, describe_places, find_places, read_cells, shrink

NONE = -20.0  # a score that excludes


def say(spot, before, white, log_precision):
    """What a network would say of one ball: fine and coarse cells."""
    cells, past = np.zeros((1, 6, 16, 16), np.float32), np.zeros((1, 4, 16, 16), np.float32)
    cells[:, 0], past[:, 0] = NONE, NONE
    for out, place in ((cells, (np.array(spot) + 0.5) / CELL), (past, (np.array(before) + AROUND + 0.5) / FAR_CELL)):
        column, row = np.floor(place).astype(int)
        out[0, 0, row, column] = 9.0
        out[0, 1:3, row, column] = place - np.floor(place) - 0.5
        if out is cells:
            out[0, 3:6, row, column] = np.log(white[0, 0]), white[1, 0], np.log(white[1, 1])
        else:
            out[0, 3, row, column] = log_precision
    return cells, past


def test_centre_covariance_and_velocity_are_what_the_cells_say():
    white = np.array([[5.0, 0.0], [-2.0, 8.0]])  # 1 / cells
    said = read_cells(*say((20.3, 41.7), (-11.2, 60.1), white, np.log(10.0)))
    np.testing.assert_allclose(said.centre[0], (20.3, 41.7), atol=1e-4)
    np.testing.assert_allclose(said.covariance[0], np.linalg.inv(white.T @ white) * CELL**2, rtol=1e-5)
    np.testing.assert_allclose(said.velocity[0], (31.5, -18.4), atol=1e-3)
    expected = 2 * (FAR_CELL / 10.0) ** 2 + np.trace(said.covariance[0]) / 2
    assert said.deviation[0] == pytest.approx(np.sqrt(expected), rel=1e-5)
    assert said.probability[0] == pytest.approx(np.exp(9) / (np.exp(9) + 1), rel=1e-5)


def test_a_ball_that_was_not_there_has_no_velocity():
    cells, past = say((20.0, 20.0), (10.0, 10.0), np.eye(2), 0.0)
    past[:, 0] = NONE
    said = read_cells(cells, past)
    assert (said.velocity == 0).all() and said.deviation[0] == module.UNKNOWN_SPEED


def test_places_are_where_the_newest_frame_alone_differs_in_grey_or_in_red():
    small = [np.full((40, 50, 2), 50, np.uint8) for _ in range(3)]
    for frame, (row, column) in zip(small, ((10, 12), (10, 24), (10, 36)), strict=True):
        frame[row - 1 : row + 2, column - 1 : column + 2, 0] = 200
    small[0][24:27, 29:32, 1] = 150
    small[0][30, 10] = small[1][30, 10] = 255  # came a frame ago
    assert find_places(small).tolist() == [[10, 12], [25, 30]]


def test_the_description_of_a_place_ignores_offset_and_contrast():
    rng, middles = np.random.default_rng(0), np.array([[6, 7]])
    frames = [rng.integers(0, 100, (20, 20, 2)).astype(np.uint8) for _ in range(3)]
    side = slice(6, 6 + 9), slice(7, 7 + 9)
    one = describe_places(frames, middles)[0]
    expected, levels = [], []
    for channel in (0, 1):
        parts = [f[side][..., channel].astype(float) for f in frames]
        mean = parts[0].mean()
        contrast = max(np.abs(part - mean).max() for part in parts) + 4
        expected += [(part - mean) / contrast for part in parts]
        levels.append((contrast, mean + 4))
    np.testing.assert_allclose(one[:-4], np.ravel(expected), atol=1e-5)
    np.testing.assert_allclose(one[-4:], np.log(np.array(levels).T.ravel()) - 3.5, atol=1e-5)


def test_a_shrunk_frame_has_grey_and_red():
    frame = np.zeros((16, 16), np.uint8)
    frame[::2, ::2], frame[1::2, 1::2] = 200, 100
    half, small = shrink(frame)
    assert (half == 75).all() and half.shape == (8, 8)
    assert (small[..., 0] == 75).all() and (small[..., 1] == 200).all() and small.shape == (4, 4, 2)
