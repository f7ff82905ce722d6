"""Causes of a stop, enumerated, and a latch that remembers them until the operator resets it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from robot_io.errors import RefusedError


class Cause(Enum):
    """Every reason for a fault; the value is its short name in logs."""

    ESTOP = "estop"  # the emergency stop is pressed, where something tells: the devices do not
    NON_FINITE_COMMAND = "non_finite_command"  # a requested velocity is NaN or infinite
    MALFORMED_COMMAND = "malformed_command"  # a request of another shape or type, or subnormal numbers
    NON_FINITE_FEEDBACK = "non_finite_feedback"  # measured positions or velocities are not eight finite numbers
    STALE_POLICY = "stale_policy"  # no new request in time
    STALE_ARM = "stale_arm"  # no feedback from the arm's controller in time
    STALE_AXES = "stale_axes"  # no feedback from the linear axes in time
    STALE_TRACKER = "stale_tracker"  # a ball in play and no word from the tracker in time
    CLOCK = "clock"  # the tracker's clock jumped, drifts or is off by more than is allowed
    TRACKER_FRAME = "tracker_frame"  # balls do not fall, bounce or pass the net where the tracker's frame has it
    AXIS_LOST = "axis_lost"  # the linear axes report an error or the connection is gone
    ARM_NOT_READY = "arm_not_ready"  # motors, RAPID or EGM are not running
    FOLLOWING_ERROR = "following_error"  # the robot is not where it was sent
    LIMIT = "limit"  # a measured position or speed is outside its limit
    CLEARANCE = "clearance"  # measured positions are in contact with table, floor or robot
    NO_WAY_HOME = "no_way_home"  # held before table, floor or robot, and no other way to the home pose is clear
    TIMING = "timing"  # commands come too fast, too late, or time goes backwards
    OPERATOR = "operator"  # asked for by a person or a program that supervises
    INTERNAL = "internal"  # a check of our own results failed


# Of the tracker, the network, the computer and the operator: they say nothing about the policy that played.
NOT_THE_POLICYS = frozenset(
    {
        Cause.ESTOP,
        Cause.OPERATOR,
        Cause.STALE_ARM,
        Cause.STALE_AXES,
        Cause.STALE_TRACKER,
        Cause.CLOCK,
        Cause.STALE_POLICY,
        Cause.TIMING,
    }
)


@dataclass(frozen=True)
class Fault:
    """One cause with the time at which it was first seen [s] and a sentence for the operator."""

    cause: Cause
    time: float
    sentence: str

    def __str__(self) -> str:
        return f"{self.cause.name} at {self.time:.3f} s: {self.sentence}"


class FaultLatch:
    """Remembers faults. The first one stays the cause; later causes are listed after it, each once.

    A cause is *present* while what raised it lasts. Conditions are reported with ``condition`` every time they are
    looked at; events, which are over as soon as they have happened, with ``event``.
    """

    def __init__(self) -> None:
        self._faults: dict[Cause, Fault] = {}
        self._present: dict[Cause, str] = {}

    @property
    def first(self) -> Fault | None:
        """The fault that stopped the robot; None: nothing is latched."""
        return next(iter(self._faults.values()), None)

    @property
    def all(self) -> tuple[Fault, ...]:
        """Every latched fault in the order in which they came."""
        return tuple(self._faults.values())

    @property
    def present(self) -> dict[Cause, str]:
        """The conditions that last, latched or not, each with its latest sentence."""
        return dict(self._present)

    def __bool__(self) -> bool:
        return bool(self._faults)

    def event(self, cause: Cause, sentence: str, now: float) -> None:
        """Latches something that has happened."""
        self._faults.setdefault(cause, Fault(cause, now, sentence))

    def condition(self, cause: Cause, present: bool, sentence: str, now: float, latch: bool = True) -> None:
        """Says whether a condition lasts. If so it is latched, or only noted when ``latch`` is false."""
        if not present:
            self._present.pop(cause, None)
            return
        self._present[cause] = sentence
        if latch:
            self.event(cause, sentence, now)

    def reset(self) -> None:
        """Forgets all faults. Raises RefusedError, and forgets nothing, while a condition is present."""
        if self._present:
            listed = "; ".join(f"{cause.name}: {sentence}" for cause, sentence in self._present.items())
            raise RefusedError(f"cannot reset while a cause is present: {listed}")
        self._faults.clear()
