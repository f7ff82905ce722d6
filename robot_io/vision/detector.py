"""Finds balls in Bayer frames, on one core: a search for what moves, and a network in windows.

The search compares quarter-size pictures of the last three frames; a small classifier orders the places that change.
The network sees the three frames of a window, 64 px in full and 128 px at half resolution. It says of each cell of 4 px
how likely the ball's centre is in it, where in the cell and with which covariance; and of each cell of 8 px in the
wider window how likely the ball was there one frame ago. Both together are the velocity.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import onnxruntime

from robot_io.vision.triangulation import Detection

SIZE = 64  # [px] of a window: fine at full, coarse at half resolution
AROUND = SIZE // 2  # [px] by which the coarse window is larger on each side
CELL = 4  # [px]
OUTPUTS = 6  # numbers of a cell
FAR_CELL = 8  # [px] of the wider window
FAR_OUTPUTS = 4  # numbers of such a cell
UNKNOWN_SPEED = 40.0  # [px a frame] deviation of a velocity that was not seen
FRAMES = 3  # that are looked at together

QUARTER = 4  # px of a frame per pixel of the search's pictures
PLACE = 4  # [quarter px] a place reaches to each side of its middle
CANDIDATES = 24  # places that the classifier orders
WINDOWS = 3  # that the search may fill
PLAUSIBLE = -3.0  # least score of a place, the logarithm of the odds of a ball, for a window
CHANGE = (4, 3)  # least change of a place [grey levels], and times the median change
APART = 12.0  # [px] between two balls, or two windows

# Columns and rows that are cut off, so that what is left begins with a red pixel.
CUT = {"RGGB": (0, 0), "GRBG": (1, 0), "GBRG": (0, 1), "BGGR": (1, 1), "mono": (0, 0)}
NETWORK, SEARCH = "ball.onnx", "search.onnx"


def shrink(frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A Bayer frame (h, w) as grey at half (h/2, w/2), and as grey and red at a quarter of its size (h/4, w/4, 2).

    Red, for an orange ball before a wall that is as bright.
    """
    half = cv2.resize(frame, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    red = cv2.resize(frame, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_NEAREST)
    both = [cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for picture in (half, red)]
    return half, cv2.merge(both)


def widen(picture: np.ndarray, by: int) -> np.ndarray:
    """A picture (h, w, ...) with its border repeated ``by`` pixels to each side."""
    return cv2.copyMakeBorder(picture, by, by, by, by, cv2.BORDER_REPLICATE)


def cut_windows(frames: Sequence[np.ndarray], corner: np.ndarray) -> np.ndarray:
    """Windows (n, SIZE, SIZE) of frames (h, w), whose corner is at x and y (2,)."""
    x, y = corner
    return np.stack([frame[y : y + SIZE, x : x + SIZE] for frame in frames])


def describe_places(small: Sequence[np.ndarray], middles: np.ndarray) -> np.ndarray:
    """Features (n, 490) of places in quarter-size frames, newest first.

    Args:
        small: FRAMES pictures (h, w, 2) with a border of PLACE pixels.
        middles: rows and columns (n, 2) without the border.

    Returns:
        Of grey and of red: the places' pixels less the newest frame's mean over their largest contrast, that contrast
        and that mean.
    """
    side = 2 * PLACE + 1
    views = [np.lib.stride_tricks.sliding_window_view(frame, (side, side), (0, 1)) for frame in small]
    patches = np.stack([view[middles[:, 0], middles[:, 1]] for view in views], 2).astype(np.float32)
    mean = patches[:, :, :1].mean((3, 4), keepdims=True)
    patches -= mean
    contrast = np.abs(patches).max((2, 3, 4), keepdims=True) + 4.0
    levels = np.log(np.concatenate([contrast[:, :, 0, 0, 0], mean[:, :, 0, 0, 0] + 4.0], 1)) - 3.5
    return np.concatenate([(patches / contrast).reshape(len(middles), -1), levels], 1)


def find_places(small: Sequence[np.ndarray]) -> np.ndarray:
    """Rows and columns (n, 2) of where the newest of the quarter-size frames (h, w, 2) differs from both others."""
    change = cv2.blur(cv2.min(cv2.absdiff(small[0], small[1]), cv2.absdiff(small[0], small[2])), (3, 3))
    usual = np.median(change[::4, ::4], axis=(0, 1))
    least = [max(CHANGE[0], CHANGE[1] * float(value)) for value in usual]
    grey, red = (cv2.subtract(channel, low) for channel, low in zip(cv2.split(change), least, strict=True))  # type: ignore[call-overload]
    change = cv2.max(grey, red)
    peaks = cv2.compare(change, cv2.max(cv2.dilate(change, np.ones((5, 5), np.uint8)), 1.0), cv2.CMP_EQ)  # type: ignore[call-overload]
    found = cv2.findNonZero(peaks)
    if found is None:
        return np.empty((0, 2), np.int64)
    xs, ys = found.reshape(-1, 2).T
    order = np.argsort(-change[ys, xs].astype(np.int16), kind="stable")[:CANDIDATES]
    return np.stack([ys[order], xs[order]], 1)


class Cells(NamedTuple):
    """The best ball of each of n windows."""

    probability: np.ndarray  # (n,)
    centre: np.ndarray  # (n, 2) [px of the window]
    covariance: np.ndarray  # (n, 2, 2) [px^2]
    velocity: np.ndarray  # (n, 2) [px a frame]
    deviation: np.ndarray  # (n,) [px a frame] of each component of the velocity


def find_cell(out: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The likeliest cell of outputs (n, c, h, w).

    Returns:
        The share (n,) of it and its neighbours, its ball's place (n, 2) [cells], and its numbers (n, c).
    """
    n, _, h, w = out.shape
    score = out[:, 0].reshape(n, -1)
    top = np.maximum(score.max(1, keepdims=True), 0.0)
    weight = np.exp(score - top)
    row, column = np.divmod(score.argmax(1), w)
    padded = np.pad(weight.reshape(n, h, w), ((0, 0), (1, 1), (1, 1)))
    index = np.arange(n)[:, None, None]
    near = padded[index, row[:, None, None] + np.arange(3)[:, None], column[:, None, None] + np.arange(3)].sum((1, 2))
    cell = out[np.arange(n), :, row, column].astype(np.float64)
    place = np.stack([column, row], 1) + 0.5 + cell[:, 1:3]
    return near / (weight.sum(1) + np.exp(-top[:, 0])), place, cell


def read_cells(cells: np.ndarray, past: np.ndarray) -> Cells:
    """The best ball of each window from what the network says: (n, OUTPUTS, h, w) and (n, FAR_OUTPUTS, h, w)."""
    probability, place, cell = find_cell(cells)
    centre = place * CELL - 0.5
    # The inverse of the factor (a 0; b c) that whitens the error.
    white_u, white_v = np.exp(-np.clip(cell[:, 3], -3, 6)), np.exp(-np.clip(cell[:, 5], -3, 6))
    root = np.zeros((len(cell), 2, 2))
    root[:, 0, 0], root[:, 1, 1], root[:, 1, 0] = white_u, white_v, -cell[:, 4] * white_u * white_v
    covariance = root @ root.transpose(0, 2, 1) * CELL**2

    known, before, far = find_cell(past)
    velocity = centre - (before * FAR_CELL - AROUND - 0.5)
    # Student's distribution of four degrees of freedom, in which the network learnt it, has twice the variance.
    spread = 2.0 * np.exp(-2.0 * np.clip(far[:, 3], -3, 6)) * FAR_CELL**2 + np.trace(covariance, axis1=1, axis2=2) / 2
    seen = known > 0.5
    velocity = np.where(seen[:, None], velocity, 0.0)
    return Cells(probability, centre, covariance, velocity, np.where(seen, np.sqrt(spread), UNKNOWN_SPEED))


def _is_apart(place: np.ndarray, others: Sequence[np.ndarray]) -> bool:
    """Whether a place [px] is farther than APART from all others; in plain numbers, which is faster for so few."""
    u, v = place.tolist()
    return not any(abs(u - x) <= APART and abs(v - y) <= APART for x, y in (other.tolist() for other in others))


class Detector:
    """Of one camera; sees its frames one after the other.

    Args:
        folder: where the network and the search's classifier are.
        rate: frames a second [Hz].
        threshold: least probability of what is reported.
        bayer: order of the frames' colours.
    """

    def __init__(self, folder: str | Path, rate: float = 125.0, threshold: float = 0.5, bayer: str = "RGGB") -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self._network, self._order = (
            onnxruntime.InferenceSession(str(Path(folder) / name), options, providers=["CPUExecutionProvider"])
            for name in (NETWORK, SEARCH)
        )
        self.rate, self.threshold = rate, threshold
        self._cut = np.array(CUT[bayer])
        self.forget()

    def forget(self) -> None:
        """Begins anew, as after frames were lost."""
        self._frames: list[np.ndarray] = []
        self._half: list[np.ndarray] = []
        self._small: list[np.ndarray] = []
        self._expected: list[np.ndarray] = []

    def detect(self, frame: np.ndarray, guesses: Sequence[np.ndarray] = ()) -> list[Detection]:
        """Balls in a frame, the surest first; none in the first two frames.

        Args:
            frame: (h, w) uint8; no copy is made, so it must not be overwritten for three frames.
            guesses: pixels (2,) where a ball is expected.

        Raises:
            ValueError: the frame is no such array, or of another size than the last one.
        """
        self._push(frame)
        if len(self._frames) < FRAMES:
            return []
        middles: list[np.ndarray] = []
        extent = np.array(self._frames[0].shape[::-1])
        for middle in [*(guess - self._cut for guess in guesses), *self._expected, *self._search()]:
            inside = (middle > -APART).all() and (middle < extent + APART).all()
            if inside and _is_apart(middle, middles):
                middles.append(middle)
        found = self._look(middles) if middles else []
        self._expected = [d.centre - self._cut + d.velocity / self.rate for d in found[:2]]
        return found

    def _push(self, frame: np.ndarray) -> None:
        if frame.ndim != 2 or frame.dtype != np.uint8 or min(frame.shape) < SIZE + QUARTER:
            raise ValueError(
                f"expected a frame (height, width) of uint8, sides of {SIZE + QUARTER} px and more, got {frame.dtype} "
                f"{frame.shape}; give the raw Bayer frame"
            )
        left, top = self._cut
        frame = frame[top:, left:]
        frame = frame[: len(frame) // QUARTER * QUARTER, : frame.shape[1] // QUARTER * QUARTER]
        if self._frames and frame.shape != self._frames[0].shape:
            raise ValueError(
                f"expected frames of {self._frames[0].shape}, got {frame.shape}; use a detector per camera"
            )
        half, small = shrink(frame)
        half, small = (widen(picture, by) for picture, by in ((half, AROUND // 2), (small, PLACE)))
        self._frames = [frame, *self._frames[: FRAMES - 1]]
        self._half = [half, *self._half[: FRAMES - 1]]
        self._small = [small, *self._small[: FRAMES - 1]]

    def _search(self) -> list[np.ndarray]:
        """Middles [px] of the places that are most like a ball that flies."""
        places = find_places([frame[PLACE:-PLACE, PLACE:-PLACE] for frame in self._small])
        if not len(places):
            return []
        score = self._order.run(None, {"places": describe_places(self._small, places)})[0]
        chosen: list[np.ndarray] = []
        for k in np.argsort(-score):
            if score[k] < PLAUSIBLE:
                break
            middle = places[k, ::-1] * float(QUARTER) + (QUARTER - 1) / 2
            if _is_apart(middle, chosen):
                chosen.append(middle)
            if len(chosen) == WINDOWS:
                break
        return chosen

    def _look(self, middles: Sequence[np.ndarray]) -> list[Detection]:
        height, width = self._frames[0].shape
        corners = np.round((np.stack(middles) - (SIZE - 1) / 2) / 2).astype(int) * 2
        corners = np.clip(corners, 0, [width - SIZE, height - SIZE])
        fine, coarse = (
            np.stack([cut_windows(frames, corner // part) for corner in corners])
            for frames, part in ((self._frames, 1), (self._half, 2))
        )
        said = read_cells(*self._network.run(None, {"fine": fine, "coarse": coarse}))
        kept: list[Detection] = []
        for k in np.argsort(-said.probability):
            spot, share = said.centre[k] + corners[k], float(said.probability[k])
            if share < self.threshold:
                break
            if _is_apart(spot + self._cut, [other.centre for other in kept]):
                speed, spread = said.velocity[k] * self.rate, float(said.deviation[k] * self.rate)
                kept.append(Detection(spot + self._cut, said.covariance[k], speed, spread, share))
        return kept
