"""Clock of the tracker from a session's log: drift by what the bridge measured, lag by the contacts with the paddle."""

from __future__ import annotations

import json
import math

from robot_io.calibrated import Calibration, ClockCalibration
from robot_io.calibration import contacts
from robot_io.log import SessionLog

LEAST = 20  # [s] of frames
SURE = 0.005  # [s] of a lag's standard deviation from which on it is kept


def fit(log: SessionLog, known: Calibration, today: str) -> tuple[ClockCalibration, list[str]]:
    """The calibration, and what was found in words. Raises ValueError for a log with too little in it."""
    reports = [json.loads(event.text) for event in log.events if event.name == "clock"]
    longest = max(reversed(reports), key=lambda report: report["seconds"], default={"seconds": 0})
    if longest["seconds"] < LEAST:
        raise ValueError(f"{longest['seconds']} s of the tracker's frames in one go; at least {LEAST} are needed")
    seen = contacts.measure(log, known)
    sure = math.isfinite(seen.lag) and seen.lag_deviation < SURE
    told = [
        f"offset {longest['offset']:+.6f} s (bridge less tracker), drift {1e6 * longest['drift']:+.2f} ppm, "
        f"seconds miss the line by {1e3 * longest['residual']:.3f} ms",
        f"{seen.count} contacts: joints are logged {1e3 * seen.lag:.1f} +- {1e3 * seen.lag_deviation:.1f} ms after the "
        f"ball; the gaps between them then spread by {1e3 * seen.spread:.1f} mm"
        if sure
        else f"{seen.count} contacts with the paddle: too few to tell the lag of the joints; lag is left empty",
    ]
    lag = round(seen.lag, 5) if sure else None
    return ClockCalibration(round(longest["drift"], 9), lag, round(longest["residual"], 7), today), told
