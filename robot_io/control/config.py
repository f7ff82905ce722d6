"""Everything that the control process has to know about one robot."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Literal

from ballmodel.io.ranges import Within, check_fields
from robot_io.calibrated import Calibration
from robot_io.contract import CONTROL_RATE, PAPER, Contract
from robot_io.control.observation import ObservationDelays
from robot_io.devices.egm.messages import N_ARM_JOINTS
from robot_io.devices.festo import AxesConfig, AxesThread, Axis, AxisProfile, CmmtProfile, FhppProfile, ModbusLink
from robot_io.devices.tracker import TrackerConfig
from robot_io.limits import LIMITS, JointLimits
from robot_io.safety.config import SafetyConfig

PROFILES: dict[str, type[CmmtProfile] | type[FhppProfile]] = {"cmmt": CmmtProfile, "fhpp": FhppProfile}
ANSWER_TIME = 0.035  # [s] for an axis to answer: less than the age at which its state counts as stale
SAME_ZERO = 1e-4  # [m] by which the zeros of a linear axis may differ from those of the robot's calibration

UNITS = ("position_unit", "velocity_unit", "base_velocity", "base_acceleration")
Port = Annotated[int, Within(1, 65535)]


@dataclass(frozen=True)
class ArmConfig:
    """EGM. host, port: where the bridge listens; controller: the arm controller's address; timeout [s] of feedback.

    controller_port: that it sends from; None: learned from the first packet, and two senders at once stop the arm
    """

    host: str = "127.0.0.1"
    port: Port = 6510
    controller: str = "127.0.0.1"
    timeout: Annotated[float, Within(0.01, 0.1, "s")] = 0.05
    controller_port: Port | None = None


@dataclass(frozen=True)
class AxisConfig:
    """One linear axis.

    zero           [m] robot's coordinate where the drive reads 0; direction 1 or -1
    combined       write and read by one request, function code 0x17; false: by 0x10 and then 0x03
    position_unit  [m] of a count in the drive's set-up, and velocity_unit [m/s]; base_velocity [m/s] and
                   base_acceleration [m/s^2] that its 100 % stand for; None: the profile's. A CMMT's are compared
    """

    host: str = "127.0.0.1"
    port: Port = 502
    device_id: Annotated[int, Within(0, 255)] = 1
    zero: Annotated[float, Within(-5.0, 5.0, "m")] = 0.0
    direction: Literal[-1, 1] = 1
    combined: bool = True
    position_unit: Annotated[float, Within(1e-9, 1e-3, "m")] | None = None
    velocity_unit: Annotated[float, Within(1e-7, 0.1, "m/s")] | None = None
    base_velocity: Annotated[float, Within(0.01, 100.0, "m/s")] | None = None
    base_acceleration: Annotated[float, Within(0.1, 1000.0, "m/s^2")] | None = None

    def profile(self, name: str) -> AxisProfile:
        """The profile of a drive with these units. Raises ValueError for a unit that it does not have."""
        kind = PROFILES[name]
        given = {key: value for key in UNITS if (value := getattr(self, key)) is not None}
        for key in given.keys() - {each.name for each in fields(kind)}:
            raise ValueError(f"axes.{key}: expected no such key, since {name} carries no such number, got {given[key]}")
        return kind(**given)


@dataclass(frozen=True)
class RealTimeConfig:
    """priority of SCHED_FIFO or None; spin [s] of busy waiting before each tick."""

    priority: Annotated[int, Within(1, 99)] | None = 50
    lock_memory: bool = True
    spin: Annotated[float, Within(0.0, 0.005, "s")] = 0.0003


@dataclass(frozen=True)
class RobotConfig:
    """An installed robot. Limits of arm and axes are the contract's; ``safety`` can only narrow what moves.

    robot  the robot that stands there: a name that comes with the program or a folder, seen from robot.yaml; None: the
           paper's. Its contract is what the gate guards by, whatever a policy says; ``check_joints`` compares
    """

    name: str = "robot"
    robot: str | None = None
    rate: Annotated[float, Within(CONTROL_RATE, CONTROL_RATE, "Hz")] = CONTROL_RATE
    arm: ArmConfig = ArmConfig()
    axis_profile: Literal["cmmt", "fhpp"] = "cmmt"
    axes: tuple[AxisConfig, ...] = (AxisConfig(), AxisConfig())
    axes_motion: AxesConfig = field(default_factory=AxesConfig)
    tracker: TrackerConfig = TrackerConfig()
    delays: ObservationDelays = ObservationDelays()
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    realtime: RealTimeConfig = RealTimeConfig()
    calibration: Calibration = Calibration()

    def __post_init__(self) -> None:
        check_fields(self)
        for axis in self.axes:
            axis.profile(self.axis_profile)
        measured, zeros = self.calibration.robot, tuple(axis.zero for axis in self.axes)
        if measured.date and any(abs(a - b) > SAME_ZERO for a, b in zip(measured.axes_zero, zeros, strict=False)):
            raise ValueError(
                f"calibration.robot.axes_zero: expected the zeros of axes, {zeros}, got {measured.axes_zero}; take "
                "calibration out of robot.yaml, note points and calibrate the robot again (mjx-tt calibrate robot)"
            )
        for path in ("arm.host", "arm.controller", "tracker.host", "tracker.source"):
            device, name = path.split(".")
            value = getattr(getattr(self, device), name)
            try:
                ipaddress.IPv4Address(value)
            except ValueError:
                raise ValueError(f"{path}: expected an IPv4 address such as 192.168.125.1, got {value!r}") from None
        if self.arm.host == "0.0.0.0":
            raise ValueError("arm.host: expected this computer's address on the arm's network, got every interface")

    @classmethod
    def of(cls, contract: Contract) -> RobotConfig:
        """The defaults for a contract's robot."""
        if contract == PAPER:
            return cls()
        return cls(axes=(AxisConfig(),) * len(contract.carrying), safety=SafetyConfig.of(contract))

    def check_joints(self, contract: Contract = PAPER) -> None:
        """Raise ValueError naming the key where this is no installation of the contract's robot."""
        arm, axes = ([contract.joints[i] for i in part] for part in (contract.arm, contract.carrying))
        measured = self.calibration.robot
        calibrated = {"joint_zeros": arm, "axes_zero": axes} if measured.date else {}
        if not N_ARM_JOINTS <= len(arm) <= 2 * N_ARM_JOINTS:
            raise ValueError(
                f"{contract.robot}: expected an arm of {N_ARM_JOINTS} to {2 * N_ARM_JOINTS} joints, which EGM carries, "
                f"got {len(arm)}"
            )
        for key, values, joints in (
            ("axes", self.axes, axes),
            ("safety.still", self.safety.still, contract.joints),
            *((f"calibration.robot.{key}", getattr(measured, key), joints) for key, joints in calibrated.items()),
        ):
            if len(values) != len(joints):
                of = f", one for each of {', '.join(joints)}" if joints else ""
                raise ValueError(f"{key}: expected {len(joints)} entries for {contract.robot}{of}, got {len(values)}")
        for i in contract.carrying:
            speed, most = self.axes_motion.speed, contract.limits.velocity[i]
            if contract != PAPER and most > speed:
                raise ValueError(
                    f"axes_motion.speed: expected at least {most} m/s, which {contract.joints[i]} of {contract.robot} "
                    f"may be asked for, got {speed} m/s"
                )
            needed = contract.limits.acceleration[i]
            if self.axes_motion.acceleration < needed:
                raise ValueError(
                    f"axes_motion.acceleration: expected at least {needed} m/s^2, by which the gate brakes "
                    f"{contract.joints[i]}, got {self.axes_motion.acceleration}: with less it runs farther than is "
                    "proven clear"
                )
            if (lead := self.axes_motion.lead) > (silence := self.safety.silence[i]):
                raise ValueError(
                    f"safety.silence[{i}]: expected at least axes_motion.lead, {lead} s, for which an axis runs on by "
                    f"itself, got {silence} s"
                )
            if (error := self.safety.following_error[i]) > 0.1:
                raise ValueError(f"safety.following_error[{i}]: expected 0.005 to 0.1 m, got {error}")


def axis_range(i: int, safety: SafetyConfig, limits: JointLimits = LIMITS) -> tuple[float, float]:
    """Range [m] that is ever commanded to linear axis ``i``: the gate's, so that no drive goes beyond it by itself."""
    room = max(limits.margin[i], safety.overshoot[i])
    return limits.lower[i] + room, limits.upper[i] - room


def linear_axes(config: RobotConfig, contract: Contract = PAPER) -> AxesThread:
    """The axes behind their Modbus connections, which the first exchange opens."""
    axes = []
    for i, axis in zip(contract.carrying, config.axes, strict=True):
        link = ModbusLink(axis.host, axis.port, ANSWER_TIME, axis.device_id, axis.combined)
        profile = axis.profile(config.axis_profile)
        low, high = axis_range(i, config.safety, contract.limits)
        axes.append(Axis(contract.joints[i], link, profile, low, high, zero=axis.zero, direction=axis.direction))
    # The gate proves the way of a command that no other one follows for no longer than that.
    timeout = min(config.axes_motion.command_timeout, config.safety.late)
    return AxesThread(axes, replace(config.axes_motion, command_timeout=timeout))
