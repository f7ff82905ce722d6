"""Everything that the control process has to know about one robot."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass, field, fields, replace

from robot_io.calibrated import RANGES as CALIBRATION_RANGES
from robot_io.calibrated import Calibration
from robot_io.contract import CONTROL_RATE, LIMITS, PAPER, Contract, JointLimits
from robot_io.control.observation import LONGEST_DELAY, ObservationDelays
from robot_io.devices.egm.messages import N_ARM_JOINTS
from robot_io.devices.festo import AxesConfig, Axis, AxisProfile, CmmtProfile, FestoAxes, FhppProfile, ModbusLink
from robot_io.devices.tracker import TrackerConfig
from robot_io.ranges import check_ranges
from robot_io.safety.config import SafetyConfig

PROFILES = {"cmmt": CmmtProfile, "fhpp": FhppProfile}
ANSWER_TIME = 0.035  # [s] for an axis to answer: less than the age at which its state counts as stale
SAME_ZERO = 1e-4  # [m] by which the zeros of a linear axis may differ from those of the robot's calibration

UNITS = ("position_unit", "velocity_unit", "base_velocity", "base_acceleration")
PORT = (1, 65535)
# Allowed in a robot.yaml: watchdogs, margins and time-outs end where they would no longer protect
# (docs/concepts/safety.md).
RANGES = {
    "rate": (CONTROL_RATE, CONTROL_RATE),
    "arm.port": PORT,
    "arm.timeout": (0.01, 0.1),
    "arm.controller_port": PORT,
    "axes.port": PORT,
    "axes.device_id": (0, 255),
    "axes.zero": (-5.0, 5.0),
    "axes.direction": (-1, 1),
    "axes.position_unit": (1e-9, 1e-3),
    "axes.velocity_unit": (1e-7, 0.1),
    "axes.base_velocity": (0.01, 100.0),
    "axes.base_acceleration": (0.1, 1000.0),
    "axes_motion.speed": (0.01, 2.0),
    "axes_motion.acceleration": (0.1, 15.0),
    "axes_motion.latency": (0.001, 0.3),
    "axes_motion.gain": (0.001, 20.0),
    "axes_motion.max_correction": (0.001, 0.5),
    "axes_motion.lead": (0.001, 0.1),
    "axes_motion.hold_speed": (0.001, 0.5),
    "axes_motion.max_error": (0.005, 0.15),
    "axes_motion.node_guard": (0.02, 0.2),
    "axes_motion.command_timeout": (0.02, 0.1),
    "axes_motion.state_timeout": (0.02, 0.1),
    "axes_motion.acknowledge_timeout": (0.1, 10.0),
    "axes_motion.enable_timeout": (0.1, 30.0),
    "axes_motion.homing_timeout": (0.1, 120.0),
    "axes_motion.overtravel": (0.0, 0.5),
    "tracker.port": PORT,
    "tracker.source_port": PORT,
    "tracker.oldest": (0.01, 0.2),
    "tracker.ahead": (0.0, 0.02),
    "tracker.clock_offset": (-1e10, 1e10),
    "tracker.clock_bound": (0.001, 0.02),
    "tracker.latency": (0.0, 0.1),
    "delays.ball": (0.0, LONGEST_DELAY),
    "delays.arm": (0.0, LONGEST_DELAY),
    "delays.axes": (0.0, LONGEST_DELAY),
    "safety.speed_scale": (0.001, 1.0),
    "safety.table_margin": (0.01, 0.5),
    "safety.self_margin": (0.01, 0.5),
    "safety.floor_margin": (0.15, 0.7),
    "safety.blade_speed": (0.05, 10.0),
    "safety.blade_acceleration": (1.0, 180.0),
    "safety.overshoot": (0.005, 0.2),
    "safety.escape_speed": (0.001, 0.1),
    "safety.still": (0.001, 0.1),
    "safety.overspeed": (1.05, 2.0),
    "safety.following_error": (0.005, 0.4),
    "safety.delay": (0.0, 0.3),
    "safety.following_ticks": (1, 6),
    "safety.late": (0.02, 0.1),
    "safety.stale_arm": (0.01, 0.1),
    "safety.stale_axes": (0.01, 0.1),
    "safety.stale_tracker": (0.01, 0.05),
    "safety.stale_policy": (0.02, 0.1),
    "realtime.priority": (1, 99),
    "realtime.spin": (0.0, 0.005),
    **{f"calibration.{key}": allowed for key, allowed in CALIBRATION_RANGES.items()},
}


@dataclass(frozen=True)
class ArmConfig:
    """EGM. host, port: where the bridge listens; controller: the arm controller's address; timeout [s] of feedback.

    controller_port: that it sends from; None: learned from the first packet, and two senders at once stop the arm
    """

    host: str = "127.0.0.1"
    port: int = 6510
    controller: str = "127.0.0.1"
    timeout: float = 0.05
    controller_port: int | None = None


@dataclass(frozen=True)
class AxisConfig:
    """One linear axis.

    zero           [m] robot's coordinate where the drive reads 0; direction 1 or -1
    combined       write and read by one request, function code 0x17; false: by 0x10 and then 0x03
    position_unit  [m] of a count in the drive's set-up, and velocity_unit [m/s]; base_velocity [m/s] and
                   base_acceleration [m/s^2] that its 100 % stand for; None: the profile's. A CMMT's are compared
    """

    host: str = "127.0.0.1"
    port: int = 502
    device_id: int = 1
    zero: float = 0.0
    direction: int = 1
    combined: bool = True
    position_unit: float | None = None
    velocity_unit: float | None = None
    base_velocity: float | None = None
    base_acceleration: float | None = None

    def profile(self, name: str) -> AxisProfile:
        """The profile of a drive with these units. Raises ValueError for a unit that it does not have."""
        kind = PROFILES[name]
        given = {key: value for key in UNITS if (value := getattr(self, key)) is not None}
        for key in given.keys() - {each.name for each in fields(kind)}:
            raise ValueError(f"axes.{key} is {given[key]}, allowed is no such key: {name} carries no such number")
        return kind(**given)


@dataclass(frozen=True)
class RealTimeConfig:
    """priority of SCHED_FIFO or None; spin [s] of busy waiting before each tick."""

    priority: int | None = 50
    lock_memory: bool = True
    spin: float = 0.0003


@dataclass(frozen=True)
class RobotConfig:
    """An installed robot. Limits of arm and axes are the contract's; ``safety`` can only narrow what moves.

    robot  the robot that stands there: a name that comes with the program or a folder, seen from robot.yaml; None: the
           paper's. Its contract is what the gate guards by, whatever a policy says; ``check_joints`` compares
    """

    name: str = "robot"
    robot: str | None = None
    rate: float = CONTROL_RATE
    arm: ArmConfig = ArmConfig()
    axis_profile: str = "cmmt"
    axes: tuple[AxisConfig, ...] = (AxisConfig(), AxisConfig())
    axes_motion: AxesConfig = field(default_factory=AxesConfig)
    tracker: TrackerConfig = TrackerConfig()
    delays: ObservationDelays = ObservationDelays()
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    realtime: RealTimeConfig = RealTimeConfig()
    calibration: Calibration = Calibration()

    def __post_init__(self) -> None:
        if self.axis_profile not in PROFILES:
            raise ValueError(f"axis_profile is {self.axis_profile!r}, allowed: {', '.join(PROFILES)}")
        check_ranges(self, RANGES)
        for i, axis in enumerate(self.axes):
            axis.profile(self.axis_profile)
            if axis.direction not in (-1, 1):
                raise ValueError(f"axes[{i}].direction is {axis.direction}, allowed are 1 and -1")
        measured, zeros = self.calibration.robot, tuple(axis.zero for axis in self.axes)
        if measured.date and any(abs(a - b) > SAME_ZERO for a, b in zip(measured.axes_zero, zeros, strict=False)):
            raise ValueError(
                f"calibration.robot.axes_zero is {measured.axes_zero}, the zeros of axes are {zeros}: the "
                "robot was calibrated with other zeros; take calibration out of robot.yaml, note points and "
                "calibrate it again (mjx-tt calibrate robot)"
            )
        for path in ("arm.host", "arm.controller", "tracker.host", "tracker.source"):
            device, name = path.split(".")
            value = getattr(getattr(self, device), name)
            try:
                ipaddress.IPv4Address(value)
            except ValueError:
                raise ValueError(f"{path} is {value!r}, allowed is an IPv4 address such as 192.168.125.1") from None

    @classmethod
    def of(cls, contract: Contract) -> RobotConfig:
        """The defaults for a contract's robot."""
        if contract == PAPER:
            return cls()
        return cls(axes=(AxisConfig(),) * len(contract.carrying), safety=SafetyConfig.of(contract))

    def check_joints(self, contract: Contract = PAPER) -> None:
        """Raise ValueError naming the key where this is no installation of the contract's robot."""
        names = [contract.joints[i] for i in contract.carrying]
        if not N_ARM_JOINTS <= len(contract.arm) <= 2 * N_ARM_JOINTS:
            raise ValueError(
                f"{contract.robot}: its arm has {len(contract.arm)} joints; allowed are {N_ARM_JOINTS} to "
                f"{2 * N_ARM_JOINTS}, which EGM carries"
            )
        if len(self.axes) != len(names):
            raise ValueError(
                f"axes: got {len(self.axes)} entries; allowed: {len(names)} for {contract.robot}, "
                f"{', '.join(names) or 'which has no linear axes'}"
            )
        if len(self.safety.still) != contract.n_joints:
            raise ValueError(
                f"safety.still has {len(self.safety.still)} numbers, allowed for {contract.robot} are "
                f"{contract.n_joints}"
            )
        for i in contract.carrying:
            speed, most = self.axes_motion.speed, contract.limits.velocity[i]
            if contract != PAPER and most > speed:
                raise ValueError(
                    f"axes_motion.speed is {speed} m/s, {contract.joints[i]} of {contract.robot} may be asked for "
                    f"{most} m/s: allowed is at least that, up to {RANGES['axes_motion.speed'][1]} m/s"
                )
            needed = contract.limits.acceleration[i]
            if self.axes_motion.acceleration < needed:
                raise ValueError(
                    f"axes_motion.acceleration is {self.axes_motion.acceleration} m/s^2, allowed is at least {needed}, "
                    f"by which the gate brakes {contract.joints[i]}: with less it runs farther than is proven clear"
                )
            if self.safety.following_error[i] > 0.1:
                raise ValueError(
                    f"safety.following_error[{i}] is {self.safety.following_error[i]} m, allowed is 0.005 to 0.1"
                )
        measured = self.calibration.robot
        for key, wanted in (("joint_zeros", [contract.joints[i] for i in contract.arm]), ("axes_zero", names)):
            given = getattr(measured, key)
            if measured.date and len(given) != len(wanted):
                raise ValueError(
                    f"calibration.robot.{key}: got {len(given)} entries; allowed: {len(wanted)} for {contract.robot}, "
                    f"{', '.join(wanted) or 'which has no linear axes'}"
                )


def axis_range(i: int, safety: SafetyConfig, limits: JointLimits = LIMITS) -> tuple[float, float]:
    """Range [m] that is ever commanded to linear axis ``i``: the gate's, so that no drive goes beyond it by itself."""
    room = max(limits.margin[i], safety.overshoot[i])
    return limits.lower[i] + room, limits.upper[i] - room


def linear_axes(config: RobotConfig, contract: Contract = PAPER) -> FestoAxes:
    """The axes behind their Modbus connections, which the first exchange opens."""
    axes = []
    for i, axis in zip(contract.carrying, config.axes, strict=True):
        link = ModbusLink(axis.host, axis.port, ANSWER_TIME, axis.device_id, axis.combined)
        profile = axis.profile(config.axis_profile)
        low, high = axis_range(i, config.safety, contract.limits)
        axes.append(Axis(contract.joints[i], link, profile, low, high, zero=axis.zero, direction=axis.direction))
    # The gate proves the way of a command that no other one follows for no longer than that.
    timeout = min(config.axes_motion.command_timeout, config.safety.late)
    return FestoAxes(axes, replace(config.axes_motion, command_timeout=timeout))
