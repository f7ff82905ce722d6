"""The table's white lines in a picture: where their edges are, to fractions of a pixel.

Along each side of the table profiles are taken across the line, and steps from white to the table's colour are looked
for; of all pairs of steps the straight course that most others lie on is the edge. White is brighter than any table,
what lies beyond the table may be brighter or darker.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from ballmodel.constants import TABLE_LENGTH, TABLE_WIDTH
from robot_io.vision.camera import Camera

LINE = 0.02  # [m] width of the white line (ITTF law 2.1.5)
POINTS = 48  # of each side
SIDES = ("left", "right", "near", "far")
BESIDE_NET = 0.12  # [m] of the long sides that the net hides or shades
BESIDE_MIDDLE = 0.02  # [m] of the short ones, where the middle line ends
STEP = 0.25  # [px] of a profile
WIDEST = 6.0  # [px] on either side that a step is judged by
CONTRAST = 8.0  # grey levels of the least step
CANDIDATES = 4  # steps of a profile
COLOURS = {
    "RGGB": "COLOR_BayerRGGB2GRAY",
    "GRBG": "COLOR_BayerGRBG2GRAY",
    "GBRG": "COLOR_BayerGBRG2GRAY",
    "BGGR": "COLOR_BayerBGGR2GRAY",
}


@dataclass(frozen=True, eq=False)
class Edges:
    """Points on the lines' inner edges in one picture.

    points   (n, 3) [m] on the table
    pixels   (n, 2) where their edge is seen, somewhere along it
    normals  (n, 2) unit vectors across the edge
    sides    (n,) numbers of ``SIDES``
    """

    points: np.ndarray
    pixels: np.ndarray
    normals: np.ndarray
    sides: np.ndarray

    def residuals(self, camera: Camera) -> np.ndarray:
        """Distances (n,) [px] of the edges of a camera's table from those seen."""
        return ((camera.project(self.points) - self.pixels) * self.normals).sum(-1)


def still_picture(frames: np.ndarray, bayer: str = "RGGB") -> np.ndarray:
    """Grey picture (h, w) of what stands still in raw frames (n, h, w): their median."""
    raw = np.median(frames, axis=0).astype(np.uint8)
    return raw if bayer == "mono" else cv2.cvtColor(raw, getattr(cv2, COLOURS[bayer]))


def find_edges(picture: np.ndarray, camera: Camera, reach: float) -> Edges:
    """The edges within ``reach`` [px] of where a camera expects them in a grey picture (h, w)."""
    smooth = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 0.8)
    parts = [_find_side(smooth, camera, side, reach) for side in range(len(SIDES))]
    points, pixels, normals = (np.concatenate([part[k] for part in parts]) for k in range(3))
    return Edges(points, pixels, normals, np.repeat(range(len(SIDES)), [len(part[0]) for part in parts]))


def _side(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) on a line's inner edge, and the direction (3,) to the table's middle."""
    across, sign = side // 2, (-1.0, 1.0)[side % 2]
    half = np.array([TABLE_WIDTH, TABLE_LENGTH]) / 2 - LINE
    along = np.linspace(-half[1 - across] + 0.03, half[1 - across] - 0.03, POINTS)
    along = along[np.abs(along) > (BESIDE_NET, BESIDE_MIDDLE)[across]]
    points, inward = np.zeros((len(along), 3)), np.zeros(3)
    points[:, 1 - across], points[:, across], inward[across] = along, sign * half[across], -sign
    return points, inward


def _find_side(picture: np.ndarray, camera: Camera, side: int, reach: float) -> tuple[np.ndarray, ...]:
    points, inward = _side(side)
    seen = camera.sees(points, 2.0)
    points = points[seen]
    nothing = np.empty((0, 3)), np.empty((0, 2)), np.empty((0, 2))
    if len(points) < 8:
        return nothing
    middle = camera.project(points)
    along = np.gradient(middle, axis=0)
    normals = np.stack([-along[:, 1], along[:, 0]], -1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    across = camera.project(points - LINE * inward) - middle
    width = np.abs((across * normals).sum(-1))  # [px] of the line
    normals *= -np.sign((across * normals).sum(-1, keepdims=True))  # to the table's middle
    steps = np.arange(-reach - WIDEST, reach + WIDEST + STEP, STEP)
    places = middle[:, None] + normals[:, None] * steps[:, None]
    lines = map_coordinates(picture, [places[..., 1], places[..., 0]], order=1, mode="nearest")
    found = [_find_steps(steps, line, w) for line, w in zip(lines, width, strict=True)]
    rows = np.concatenate([np.full(len(f), i) for i, f in enumerate(found)]).astype(int)
    offsets = np.concatenate(found)
    chosen = _agree(rows, offsets, len(points), max(1.0, 0.06 * reach))
    if len(chosen) < 0.3 * len(points):
        return nothing
    rows, offsets = rows[chosen], offsets[chosen]
    return points[rows], middle[rows] + normals[rows] * offsets[:, None], normals[rows]


def _find_steps(offsets: np.ndarray, line: np.ndarray, width: float) -> np.ndarray:
    """Offsets [px] of a profile's steps from bright to dark, the largest ones."""
    w = max(int(round(0.6 * min(width, 8.0) / STEP)), 3)
    total = np.concatenate([[0.0], np.cumsum(line)])
    k = np.arange(w, len(line) - w)
    step = (2 * total[k] - total[k - w] - total[k + w]) / w  # mean before less mean behind
    peak = np.flatnonzero((step[1:-1] > step[:-2]) & (step[1:-1] >= step[2:]) & (step[1:-1] > CONTRAST)) + 1
    peak = peak[np.argsort(-step[peak])[:CANDIDATES]]
    slope = np.gradient(line)
    out = []
    for i in (peak + w).tolist():  # the steepest place near the peak, by a parabola
        near = slice(max(i - w, 1), min(i + w, len(line) - 1))
        j = near.start + int(np.argmin(slope[near]))
        j = min(max(j, 1), len(line) - 2)
        bend = slope[j - 1] - 2 * slope[j] + slope[j + 1]
        shift = 0.5 * (slope[j - 1] - slope[j + 1]) / bend if bend > 0 else 0.0
        out.append(offsets[j] + STEP * float(np.clip(shift, -1, 1)))
    return np.array(out)


def _agree(rows: np.ndarray, offsets: np.ndarray, count: int, within: float) -> np.ndarray:
    """Of steps (n,) in profiles, those on the straight course offset = a + b row that passes most profiles."""
    if len(rows) < 8:
        return np.empty(0, int)
    rng = np.random.default_rng(0)
    best, most = np.empty(0, int), 0.0
    for _ in range(400):
        i, j = rng.integers(0, len(rows), 2)
        if abs(rows[i] - rows[j]) < count / 4:
            continue
        slope = (offsets[j] - offsets[i]) / (rows[j] - rows[i])
        away = np.abs(offsets - offsets[i] - slope * (rows - rows[i]))
        near = np.flatnonzero(away < within)
        score = len(np.unique(rows[near])) - 0.3 * away[near].mean() / within
        if score > most:
            best, most = near, score
    _, first = np.unique(rows[best], return_index=True)
    return best[first]
