"""Patterns of a fit's residual that are not noise and that no effect of the catalogue explains."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mjx_tt.diagnosis.joint.basis_functions import Block, blocks
from mjx_tt.diagnosis.joint.fit import Fit, Fitter
from mjx_tt.diagnosis.joint.log import JointLog
from mjx_tt.diagnosis.joint.scores import FLOOR, SMALLEST_NOISE, Judge, weights


@dataclass(frozen=True)
class Finding:
    """The block that explains most of a residual."""

    block: Block
    size: float  # [rad], [m] rms that the block predicts on windows it was not fitted to
    where: str
    direction: str


def find(fitter: Fitter, fit: Fit, sigma: float) -> Finding | None:
    """The block that explains most of a fit's residual, None where none explains anything worth a word."""
    log, r = fitter.log, fit.residual
    weight = weights(r, sigma)
    root = np.sqrt(weight)
    known = log.centred(fitter.jacobian(fit.values), weight) * root[:, None]
    known /= np.linalg.norm(known, axis=0) + 1e-12
    prepared = []
    for block in (nameless := blocks(log, fit)):
        columns = log.centred(block.columns, weight) * root[:, None]
        columns = columns - known @ np.linalg.lstsq(known, columns, rcond=1e-8)[0]
        size = np.linalg.norm(columns, axis=0)
        prepared.append(columns / np.maximum(size, 1e-12 + 1e-6 * size.max(initial=0.0)))
    y = root * r
    together = np.concatenate(prepared, axis=1)
    judge = Judge(log, y - together @ _ridge(together, y))
    even = log.window % 2 == 0
    best, highest = None, 0.0
    for block, columns in zip(nameless, prepared, strict=True):
        coefficients = _ridge(columns, y)
        explained = y @ (columns @ coefficients) / judge.sigma**2 / judge.inflation
        count = columns.shape[1]
        score = explained - count - 6.0 * math.sqrt(2.0 * count) - 20.0 - 2.0 * math.log(block.tried)
        predicted = np.where(even, columns @ _ridge(columns[~even], y[~even]), columns @ _ridge(columns[even], y[even]))
        size = math.sqrt(max(np.mean(y * y) - np.mean((y - predicted) ** 2), 0.0))
        if score > highest and size > FLOOR:
            best, highest = Finding(block, size, *block.where(coefficients)), score
    return best or _moments(log, r)


def _moments(log: JointLog, r: np.ndarray) -> Finding | None:
    """Windows in which the joint was somewhere else for a while, which no function of its motion explains."""
    from scipy.ndimage import median_filter  # half a second to import, which logs without joints need not

    smooth = median_filter(r, 9)
    counts = np.diff(np.append(log.starts, r.size))
    slow, quick = (np.add.reduceat(x * x, log.starts) / counts for x in (smooth, r - smooth))
    usual = float(np.median(slow)) + SMALLEST_NOISE**2
    odd = (slow > 25.0 * usual) & (slow > 4.0 * quick)
    size = math.sqrt(float(np.sum(np.where(odd, slow, 0.0) * counts)) / r.size)
    if size < FLOOR:
        return None
    worst = int(np.argmax(np.where(odd, slow, 0.0)))
    columns = log.centred(smooth * odd[log.window])[:, None]
    begin = log.time[log.starts[worst]] - log.time[0]
    where = f"{int(odd.sum())} of {odd.size} windows of {log.width:.2g} s, most at {begin:.1f} s in the log"
    return Finding(Block("moments", columns, lambda c: (where, "both")), size, where, "both")


def _ridge(columns: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Coefficients (m,) of columns (n, m), a little held back where they say the same."""
    normal = columns.T @ columns
    little = 1e-7 * np.trace(normal) / len(normal) + 1e-12
    return np.linalg.solve(normal + little * np.eye(len(normal)), columns.T @ y)
