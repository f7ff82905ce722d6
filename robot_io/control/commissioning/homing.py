"""Ways to a known place: of the axes to their references, past the gate, so the arm must be clear; of the robot."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from robot_io.contract import PAPER, Contract
from robot_io.control.commissioning.dry import DryAxes
from robot_io.devices.festo import AxesThread
from robot_io.devices.fixed_base import FixedBase
from robot_io.errors import JogFirstError, RefusedError
from robot_io.safety.clearance import RobotGeometry

HOMING_GAP = 0.03  # [m] of everything to everything while the linear axes search their references
HOMING_PLACES = 21  # along each axis at which that is looked at


def check_homing(geometry: RobotGeometry, measured: np.ndarray, contract: Contract = PAPER) -> None:
    """Raise RefusedError unless the arm, measured (n,), is clear of everything wherever the linear axes may go."""
    if not np.isfinite(measured[list(contract.arm)]).all():
        raise RefusedError("axes not homed: the arm's position is not known; start its EGM session first")
    if not contract.carrying:
        return
    limits = contract.limits
    places = np.meshgrid(*(np.linspace(limits.lower[i], limits.upper[i], HOMING_PLACES) for i in contract.carrying))
    q = np.repeat(measured[:, None], places[0].size, axis=1)
    q[list(contract.carrying)] = [axis.ravel() for axis in places]
    gaps = geometry.gaps(q)
    if not gaps.min() > HOMING_GAP:
        row = geometry.rows[int(gaps.min(axis=1).argmin())]
        raise JogFirstError(
            f"axes not homed: somewhere on their way {row} comes as near as {gaps.min():.3f} m, allowed is "
            f"{HOMING_GAP} m; jog the arm to its home pose first"
        )


def prepare(axes: AxesThread | DryAxes | FixedBase, check: Callable[[], None]) -> None:
    """Acknowledge faults, switch on, home what is not homed; ``check`` raises RefusedError where that is not safe."""
    if axes.axes.fault:
        axes.acknowledge()
    axes.enable()
    if not axes.axes.answering:  # whether they must be homed is not known: a cable was out
        raise RefusedError("axes not ready: one of them does not answer yet; try again")
    if not axes.axes.homed:
        check()
        axes.home()


def towards(target: np.ndarray, at: np.ndarray, speed: np.ndarray, braking: np.ndarray, period: float) -> np.ndarray:
    """Velocity (8,) from ``at`` to the target: at most ``speed``, and such that ``braking`` suffices to stop there."""
    error = target - at
    distance = np.abs(error)
    wanted = np.minimum(speed, np.sqrt(2.0 * braking * distance))
    wanted = np.minimum(wanted, distance / (3.0 * period))
    return np.where(distance < 1e-4, 0.0, np.sign(error) * wanted)
