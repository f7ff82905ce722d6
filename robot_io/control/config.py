"""Everything that the control process has to know about one robot."""

from __future__ import annotations

from dataclasses import dataclass, field

from robot_io.contract import CONTROL_RATE, FESTO_JOINTS, LIMITS
from robot_io.control.observation import ObservationDelays
from robot_io.devices.festo import AxesConfig, Axis, CmmtProfile, FestoAxes, FhppProfile, ModbusLink
from robot_io.devices.tracker import TrackerConfig
from robot_io.safety.config import SafetyConfig

PROFILES = {"cmmt": CmmtProfile, "fhpp": FhppProfile}
ANSWER_TIME = 0.035  # [s] for an axis to answer: less than the age at which its state counts as stale
AXIS_NAMES = ("gantry_x", "gantry_y")


@dataclass(frozen=True)
class ArmConfig:
    """EGM. host, port: where the bridge listens; controller: the arm controller's address; timeout [s] of feedback."""

    host: str = "127.0.0.1"
    port: int = 6510
    controller: str = "127.0.0.1"
    timeout: float = 0.05


@dataclass(frozen=True)
class AxisConfig:
    """One linear axis. zero [m]: robot's coordinate where the drive reads 0; direction 1 or -1."""

    host: str = "127.0.0.1"
    port: int = 502
    device_id: int = 1
    zero: float = 0.0
    direction: int = 1


@dataclass(frozen=True)
class RealTimeConfig:
    """priority of SCHED_FIFO or None; spin [s] of busy waiting before each tick."""

    priority: int | None = 50
    lock_memory: bool = True
    spin: float = 0.0003


@dataclass(frozen=True)
class RobotConfig:
    """A robot. The arm's and the axes' limits are the contract's; ``safety`` can only narrow what moves."""

    name: str = "robot"
    rate: float = CONTROL_RATE
    arm: ArmConfig = ArmConfig()
    axis_profile: str = "cmmt"
    axes: tuple[AxisConfig, AxisConfig] = (AxisConfig(), AxisConfig())
    axes_motion: AxesConfig = field(default_factory=AxesConfig)
    tracker: TrackerConfig = TrackerConfig()
    delays: ObservationDelays = ObservationDelays()
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    realtime: RealTimeConfig = RealTimeConfig()

    def __post_init__(self) -> None:
        if self.rate != CONTROL_RATE:
            raise ValueError(f"rate is {self.rate} Hz, policies act at {CONTROL_RATE} Hz")
        if self.axis_profile not in PROFILES:
            raise ValueError(f"axis_profile {self.axis_profile!r} does not exist, allowed: {', '.join(PROFILES)}")
        if len(self.axes) != len(FESTO_JOINTS):
            raise ValueError(f"{len(self.axes)} axes given, the robot has {len(FESTO_JOINTS)}: {', '.join(AXIS_NAMES)}")


def axis_range(i: int) -> tuple[float, float]:
    """Range [m] that is ever commanded to linear axis ``i``: the limiter's."""
    return LIMITS.lower[i] + LIMITS.margin[i], LIMITS.upper[i] - LIMITS.margin[i]


def linear_axes(config: RobotConfig) -> FestoAxes:
    """The axes behind their Modbus connections, which the first exchange opens."""
    axes = []
    for i, axis in enumerate(config.axes):
        link = ModbusLink(axis.host, axis.port, ANSWER_TIME, axis.device_id)
        profile = PROFILES[config.axis_profile]()
        axes.append(Axis(AXIS_NAMES[i], link, profile, *axis_range(i), zero=axis.zero, direction=axis.direction))
    return FestoAxes(axes, config.axes_motion)
