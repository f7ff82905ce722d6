"""A calibration against the contacts of ball and paddle in the last session that was played with it."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from experiments.config import robot as robots
from experiments.errors import ConfigError
from robot_io import log
from robot_io.calibration import contacts
from robot_io.control.config import RobotConfig

LAG = 0.005  # [s] by which the joints' lag may differ from the calibrated one, on top of two standard deviations
SESSIONS = Path("runs/robot")  # where mjx-tt run leaves them unless told otherwise
SPREAD = 0.015  # [m] of the gaps at contacts, beyond which tracker or robot is not where it is said to be


def measure(config: RobotConfig, log_file: Path | None) -> dict[str, float | None] | None:
    """Contacts in a session's log, null where too few tell; None without a log, or where nothing is calibrated.

    Raises LogError.
    """
    found = config.calibration
    if log_file is None or not log_file.exists() or not (found.tracker.date or found.robot.date or found.clock.date):
        return None
    seen = asdict(contacts.measure(log.read(log_file), found))
    return {key: value if math.isfinite(value) else None for key, value in seen.items()}


def check(config: RobotConfig, where: str, log_folder: Path = SESSIONS) -> None:
    """Raise ConfigError where the newest session of this robot with this calibration contradicts it."""
    same = robots.plain(config.calibration)
    for path in sorted(log_folder.glob("*.json"), reverse=True):
        try:
            session = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            continue
        if isinstance(session, dict) and session.get("robot") == config.name and session.get("calibration") == same:
            _judge(config, session.get("contacts") or {}, where, path)
            return


def _judge(config: RobotConfig, seen: dict[str, Any], where: str, path: Path) -> None:
    lag, spread, deviation = (seen.get(key) for key in ("lag", "spread", "lag_deviation"))
    if lag is None or spread is None or deviation is None or not math.isfinite(lag):
        return
    again = f"calibrate again, or remove {path} if it was an exception"
    if spread > SPREAD:
        raise ConfigError(
            f"{where}: calibration.tracker.position and calibration.robot.joint_zeros: in {path} the gaps between ball "
            f"and blade spread by {1e3 * spread:.1f} mm, allowed are {1e3 * SPREAD:g}; {again}"
        )
    known = config.calibration.clock.lag
    if known is not None and abs(lag - known) > LAG + 2.0 * deviation:
        raise ConfigError(
            f"{where}: calibration.clock.lag is {known} s, in {path} {seen['count']} contacts show {lag:.4f} s; {again}"
        )
