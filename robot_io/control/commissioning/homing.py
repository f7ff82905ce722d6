"""Ways to a known place: of the axes to their references, past the gate, so the arm must be clear; of the robot."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from robot_io.contract import PAPER, Contract
from robot_io.control.commissioning.dry import DryAxes
from robot_io.devices.egm.session import EgmSession
from robot_io.devices.festo import AxesThread
from robot_io.devices.fixed_base import FixedBase
from robot_io.errors import JogFirstError, RefusedError
from robot_io.safety.clearance import RobotGeometry

HOMING_GAP = 0.03  # [m] of everything to everything while the linear axes search their references
HOMING_PLACES = 21  # along each axis at which that is looked at, at least
HOMING_STEP = 0.1  # [m] between them, at most
SLIP = 0.01  # [rad] by which a joint of the arm may leave its place meanwhile: 2 cm of the gap for a stretched arm


def check_homing(
    geometry: RobotGeometry, measured: np.ndarray, contract: Contract = PAPER, overtravel: float = 0.0
) -> None:
    """Raise RefusedError unless the arm, measured (n,), is clear of everything wherever the linear axes may go.

    overtravel [m]: beyond their range at both ends, where switches and stops are that a search may run into.
    """
    if not np.isfinite(measured[list(contract.arm)]).all():
        raise RefusedError("axes not homed: the arm's position is not known; start its EGM session first")
    if not contract.carrying:
        return
    limits = contract.limits
    places = np.meshgrid(
        *(_search(limits.lower[i] - overtravel, limits.upper[i] + overtravel) for i in contract.carrying)
    )
    q = np.repeat(measured[:, None], places[0].size, axis=1)
    q[list(contract.carrying)] = [axis.ravel() for axis in places]
    gaps = geometry.gaps(q)
    if not gaps.min() > HOMING_GAP:
        row = geometry.rows[int(gaps.min(axis=1).argmin())]
        raise JogFirstError(
            f"axes not homed: somewhere on their way {row} comes as near as {gaps.min():.3f} m, allowed is "
            f"{HOMING_GAP} m; jog the arm to its home pose first, or away from there"
        )


def _search(lower: float, upper: float) -> np.ndarray:
    """Places [m] of an axis, at most ``HOMING_STEP`` apart."""
    return np.linspace(lower, upper, max(HOMING_PLACES, math.ceil((upper - lower) / HOMING_STEP) + 1))


class HomedAxes(Protocol):
    """Linear axes as far as it matters here."""

    @property
    def homing(self) -> bool: ...

    def stop(self) -> None: ...


class HomingGuard:
    """Watches the arm before and while the linear axes search their references, past the gate.

    joints  gives the newest positions and velocities of the joints, both (n,)
    still   speed (n,) above which a joint counts as moving
    overtravel  as of ``check_homing``
    """

    def __init__(
        self,
        arm: EgmSession,
        axes: HomedAxes,
        joints: Callable[[], tuple[np.ndarray, np.ndarray]],
        geometry: RobotGeometry,
        contract: Contract,
        still: tuple[float, ...],
        overtravel: float = 0.0,
    ) -> None:
        self._arm, self._axes, self._joints = arm, axes, joints
        self._geometry, self._contract, self._overtravel = geometry, contract, overtravel
        self._rows = list(contract.arm)
        self._still = np.array(still)[self._rows]
        self._place: np.ndarray | None = None  # of the arm when the search began

    def check(self, state: str, now: float) -> None:
        """Raise RefusedError unless the axes may begin, in the bridge's ``state``.

        The robot must be disarmed, the arm, heard of just now, ready and at rest, clear of everything wherever they go.
        """
        if state != "disarmed":
            first = "reset it first, then home them" if state == "fault" else "stop the robot first"
            raise RefusedError(f"axes not homed: the state is {state}; {first}")
        measured, velocity = self._joints()
        if not np.isfinite(measured[self._rows]).all():
            raise RefusedError("axes not homed: the arm's position is not known; start its EGM session first")
        trouble = self._trouble(velocity[self._rows], now)
        if trouble:
            raise RefusedError(f"axes not homed: {trouble}")
        check_homing(self._geometry, measured, self._contract, self._overtravel)

    def watch(self, now: float) -> str:
        """Stop axes that are being homed when the arm cannot be trusted to stay; the reason, empty: nothing is wrong.

        Called at every control tick.
        """
        if not self._axes.homing:
            self._place = None
            return ""
        measured, velocity = self._joints()
        place = measured[self._rows]
        if self._place is None:
            self._place = place
        trouble = self._trouble(velocity[self._rows], now)
        if not trouble and not (np.abs(place - self._place) <= SLIP).all():
            trouble = f"the arm has left its place by {np.abs(place - self._place).max():.3f} rad"
        if trouble:
            self._axes.stop()
        return trouble

    def _trouble(self, velocity: np.ndarray, now: float) -> str:
        """Reason to doubt where the arm is or that it stays there, by its speed (6,) too; empty: none."""
        problem = self._arm.problem(now)
        if problem:
            return f"where the arm is must be sure: {problem}"
        if (np.abs(velocity) > self._still).any():
            return f"the arm moves at {np.abs(velocity).max():.2f} rad/s"
        return ""


def prepare(axes: AxesThread | DryAxes | FixedBase, check: Callable[[], None]) -> None:
    """Acknowledge faults, switch on, home what is not homed; ``check`` raises RefusedError where that is not safe.

    Until it is, nothing is homed: what is asked for here passes the gate by.
    """
    if axes.fault:
        axes.acknowledge()
    axes.enable()
    if not axes.answering:  # whether they must be homed is not known: a cable was out
        raise RefusedError("axes not ready: one of them does not answer yet; try again")
    if not axes.homed:
        check()
        axes.home()


def towards(target: np.ndarray, at: np.ndarray, speed: np.ndarray, braking: np.ndarray, period: float) -> np.ndarray:
    """Velocity (8,) from ``at`` to the target: at most ``speed``, and such that ``braking`` suffices to stop there."""
    error = target - at
    distance = np.abs(error)
    wanted = np.minimum(speed, np.sqrt(2.0 * braking * distance))
    wanted = np.minimum(wanted, distance / (3.0 * period))
    return np.where(distance < 1e-4, 0.0, np.sign(error) * wanted)
