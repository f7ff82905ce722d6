"""Messages over the pipe between the control process and its owner: requests to it, reports from it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from robot_io.control.commissioning import jog
from robot_io.control.commissioning.mark import Stay
from robot_io.control.episode import EpisodeSummary
from robot_io.control.rally import RallySummary
from robot_io.errors import RefusedError
from robot_io.policy.policy import Policy

if TYPE_CHECKING:
    from robot_io.control.bridge import Bridge
    from robot_io.control.commissioning.dry import DryAxes
    from robot_io.control.timings import Timings
    from robot_io.devices.festo import AxesThread
    from robot_io.devices.fixed_base import FixedBase


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
    """Mark the ball that the operator has seen last as not to be used. Answered by Discarded."""


@dataclass(frozen=True)
class Pause:
    """Take no new balls, or take them again."""

    on: bool


@dataclass(frozen=True)
class Jog:
    """Move the joints by a step (n,) [m], [rad], or the blade by (3,) [m] in the table frame, without turning it.

    share   of the policy's speed limits, which the gate scales once more
    pulled  the arm is told where to be and no speed to go on with: only its position correction moves it
    """

    step: tuple[float, ...]
    share: float = jog.SPEED
    pulled: bool = False


@dataclass(frozen=True)
class Mark:
    """Tell where ball and joints were during the last second. Answered by Marked."""


@dataclass(frozen=True)
class Trace:
    """Tell how the joints followed during the last seconds. Answered by Traced."""


@dataclass(frozen=True)
class Mute:
    """Do not answer the arm's controller until its EGM ends, for at most so many seconds. Answered by Muted."""

    seconds: float


@dataclass(frozen=True)
class SetPolicy:
    """Exchange the policy; ``version`` is in the summary of every episode that it plays. Answered by PolicySet."""

    policy: Policy
    version: int


@dataclass(frozen=True)
class Quit:
    """Stop the robot and end the process."""


@dataclass(frozen=True)
class Beat:
    """Sign of life: the owner reads the operator's keys. Every other request is one as well.

    absence  [s] until the next one, where the owner computes meanwhile; only while paused, and within
             ``robot_io.safety.owner_watch.LONGEST_ABSENCE``
    """

    absence: float = 0.0


Request = Prepare | Arm | Stop | Reset | Discard | Pause | Jog | Mark | Trace | Mute | SetPolicy | Quit | Beat


@dataclass(frozen=True)
class Ready:
    """The loop starts; ``report``: what the system granted and refused."""

    report: list[str]


@dataclass(frozen=True)
class Refused:
    """The reason why ``request`` was not carried out."""

    request: Request
    error: RefusedError

    @property
    def sentence(self) -> str:
        return str(self.error)


@dataclass(frozen=True)
class PolicySet:
    """Balls that begin from now on are played by this version."""

    version: int


@dataclass(frozen=True)
class Discarded:
    """The ball that the operator has discarded, by ``EpisodeSummary.number``; 0: there was none yet."""

    number: int


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
class Marked:
    """Stays of the ball (3,) [m] in the table frame, the linear axes [m] and the arm's joints [rad]."""

    ball: Stay
    axes: Stay
    arm: Stay


@dataclass(frozen=True)
class Traced:
    """Ticks (t,) [s], the gate's reference and the measured position (t, n) [m], [rad] at each."""

    time: np.ndarray
    reference: np.ndarray
    measured: np.ndarray


@dataclass(frozen=True)
class Muted:
    """Time [s] without answers after which EGM had ended; None: it had not."""

    seconds: float | None


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
    unproven        what must be seen of the tracker's frame and clock before it is armed; None: nothing
    tracker_trouble, clock_trouble  the reasons why its frames were refused, and its clock is not to be trusted
    shown           balls so far that bounced where they must
    present         sentences of conditions that keep the robot from being armed, by cause
    arm, axes, tracker  the reason why each cannot be used, or None
    ramping         the reason why the arm does not follow fully yet, which passes by itself, or None
    homing          the axes search their references
    preparable      the axes' reason is none that Prepare does not mend: they are switched off or not homed
    joints          name, unit, measured position, commanded velocity of each joint
    ball            (3) [m] where the tracker's newest frame shows it, in the table frame; None: nowhere
    clock           ``Clock.report`` of the tracker's
    dry             nothing is sent: arm and axes move in thought
    outcomes        balls by outcome
    rally           paddle touches of the rally in play
    rallies         that count, with the mean_rally and longest_rally of them; last_rally: the last one in words
    egm             fields of ``EgmStatistics``
    tracker_counts  datagrams by fate
    stopped         the reason of a stop that no operator asked for, until it is armed again; empty: none
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
    joints: list[tuple[str, str, float, float]]
    ball: tuple[float, ...] | None = None
    clock: dict[str, float] = field(default_factory=dict)
    dry: bool = False
    policy_version: int = 0
    balls: int = 0
    outcomes: dict[str, int] = field(default_factory=dict)
    rally: int = 0
    rallies: int = 0
    mean_rally: float = 0.0
    longest_rally: int = 0
    last_rally: str = ""
    preparable: bool = False
    homing: bool = False
    egm: dict[str, Any] = field(default_factory=dict)
    tracker_counts: dict[str, int] = field(default_factory=dict)
    axes_cycles: int = 0
    axes_late: int = 0
    log_dropped: int = 0
    timings: dict[str, Any] = field(default_factory=dict)
    stopped: str = ""
    unproven: str | None = None
    ramping: str | None = None
    shown: int = 0
    tracker_trouble: str | None = None
    clock_trouble: str | None = None

    @classmethod
    def of(
        cls,
        bridge: Bridge,
        axes: AxesThread | DryAxes | FixedBase,
        timings: Timings,
        dropped: int,
        now: float,
        dry: bool,
    ) -> Status:
        """The state at ``now``; ``dropped``: records that the log lost."""
        counts, tracker, session = bridge.counts, bridge.tracker, bridge.arm_session
        contract = bridge.config.contract
        seen = tracker.newest
        positions, velocities = bridge.measured.tolist(), bridge.gate.velocity.tolist()
        return cls(
            time=now,
            state=bridge.state.value,
            paused=bridge.paused,
            at_home=bridge.state.value in ("ready", "active") and bridge.at_home,
            faults=tuple(FaultReport(f.cause.value, f.sentence) for f in bridge.gate.faults),
            present={cause.value: text for cause, text in bridge.gate.present.items()},
            arm=session.problem(now),
            ramping=session.ramping(now),
            axes=axes.problem(now),
            tracker=tracker.problem(now),
            joints=list(zip(contract.joints, contract.units, positions, velocities, strict=True)),
            ball=None if seen is None or seen.position is None else tuple(seen.position.tolist()),
            clock=tracker.clock.report(),
            dry=dry,
            policy_version=bridge.policy_version,
            balls=counts.balls,
            outcomes=dict(counts.outcomes),
            rally=counts.rallies.touches,
            rallies=counts.rallies.rallies,
            mean_rally=counts.rallies.touched / max(counts.rallies.rallies, 1),
            longest_rally=counts.rallies.longest,
            last_rally=counts.rallies.last,
            preparable=axes.preparable(now),
            homing=axes.homing,
            egm=asdict(session.statistics),
            tracker_counts=dict(tracker.counts),
            axes_cycles=axes.cycles,
            axes_late=axes.late,
            log_dropped=dropped,
            timings=timings.summary(),
            stopped=bridge.stopped_because,
            unproven=bridge.unproven,
            shown=bridge.frame_check.shown,
            tracker_trouble=tracker.refused,
            clock_trouble=tracker.refused or tracker.clock.unready,
        )

    @property
    def halt(self) -> FaultReport | None:
        """The reason why a robot that was armed is so no longer, though nobody asked for it; None: none."""
        return self.faults[0] if self.faults else FaultReport("stopped", self.stopped) if self.stopped else None

    @property
    def missing(self) -> str:
        """The devices that cannot be used, each with its reason; empty: none."""
        found = {"arm": self.arm or self.ramping, "axes": self.axes, "tracker": self.tracker}
        return "; ".join(f"{name}: {reason}" for name, reason in found.items() if reason)


Message = (
    Ready | Refused | PolicySet | Discarded | Played | RallyOver | Marked | Traced | Muted | Failed | Ended | Status
)
