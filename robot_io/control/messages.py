"""Messages over the pipe between the control process and its owner: requests to it, reports from it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robot_io.control.episode import EpisodeSummary
from robot_io.control.rally import RallySummary
from robot_io.policy.policy import Policy


@dataclass(frozen=True)
class Prepare:
    """Acknowledge faults of the linear axes, switch them on and home them."""


@dataclass(frozen=True)
class Arm:
    """Arm the gate; the robot goes to its home pose."""


@dataclass(frozen=True)
class Stop:
    """Slow down to rest and disarm."""


@dataclass(frozen=True)
class Reset:
    """Forget the faults."""


@dataclass(frozen=True)
class Discard:
    """Mark the ball in play, or the one before, as not to be used."""


@dataclass(frozen=True)
class Pause:
    """Take no new balls, or take them again."""

    on: bool


@dataclass(frozen=True)
class SetPolicy:
    """Exchange the policy; ``version`` is in the summary of every episode that it plays. Answered by PolicySet."""

    policy: Policy
    version: int


@dataclass(frozen=True)
class Quit:
    """Stop the robot and end the process."""


Request = Prepare | Arm | Stop | Reset | Discard | Pause | SetPolicy | Quit


@dataclass(frozen=True)
class Ready:
    """The loop starts; ``report``: what the system granted and refused."""

    report: list[str]


@dataclass(frozen=True)
class Refused:
    """The reason why ``request`` was not carried out."""

    request: Request
    sentence: str


@dataclass(frozen=True)
class PolicySet:
    """Balls that begin from now on are played by this version."""

    version: int


@dataclass(frozen=True)
class Played:
    """One ball with its outcome; ``ball`` (n, 4): t [s], x, y, z [m] of its way to the robot."""

    summary: EpisodeSummary
    ball: np.ndarray


@dataclass(frozen=True)
class RallyOver:
    """One rally with its length and end."""

    summary: RallySummary


@dataclass(frozen=True)
class Failed:
    """The process ends; the robot stands."""

    sentence: str


@dataclass(frozen=True)
class Ended:
    """The last message: ``Timings.summary``."""

    timings: dict[str, Any]


@dataclass(frozen=True)
class FaultReport:
    """One latched fault: its cause's short name and a sentence."""

    cause: str
    text: str


@dataclass(frozen=True)
class Status:
    """State of everything, for the operator's view.

    time            [s] of the control process's clock
    state           value of the ``BridgeState``
    present         sentences of conditions that keep the robot from being armed, by cause
    arm, axes, tracker  the reason why each cannot be used, or None
    joints          name, measured position, commanded velocity of each joint
    outcomes        balls by outcome
    rally           paddle touches of the rally in play
    rallies         that count, with the mean_rally and longest_rally of them; last_rally: the last one in words
    egm             fields of ``EgmStatistics``
    tracker_counts  datagrams by fate
    """

    time: float
    state: str
    paused: bool
    at_home: bool
    faults: tuple[FaultReport, ...]
    present: dict[str, str]
    arm: str | None
    axes: str | None
    tracker: str | None
    joints: list[tuple[str, float, float]]
    policy_version: int = 0
    balls: int = 0
    outcomes: dict[str, int] = field(default_factory=dict)
    rally: int = 0
    rallies: int = 0
    mean_rally: float = 0.0
    longest_rally: int = 0
    last_rally: str = ""
    egm: dict[str, Any] = field(default_factory=dict)
    tracker_counts: dict[str, int] = field(default_factory=dict)
    axes_cycles: int = 0
    axes_late: int = 0
    log_dropped: int = 0
    timings: dict[str, Any] = field(default_factory=dict)

    @property
    def missing(self) -> str:
        """The devices that cannot be used, each with its reason; empty: none."""
        found = {"arm": self.arm, "axes": self.axes, "tracker": self.tracker}
        return "; ".join(f"{name}: {reason}" for name, reason in found.items() if reason)


Message = Ready | Refused | PolicySet | Played | RallyOver | Failed | Ended | Status
