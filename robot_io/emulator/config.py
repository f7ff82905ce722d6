"""Everything about the emulated robot, in one place."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from ballmodel.io.ranges import Within, check_fields
from robot_io.contract import PAPER, Contract
from robot_io.emulator.arm import ArmParams
from robot_io.emulator.axes import AxisEmulator
from robot_io.emulator.axis_drive import DriveParams
from robot_io.emulator.axis_registers import REGISTERS
from robot_io.emulator.hidden import NOTHING_HIDDEN, HiddenErrors
from robot_io.emulator.network import NetworkFaults
from robot_io.emulator.tracker import TrackerParams
from robot_io.emulator.world import WorldParams

AXIS_FEEDBACK_DELAY = 0.033  # [s], paper: latency of the linear axes' observation
# Training knows the time from a command to its effect; of the paper's 0.071 and 0.0645 s so much is no dead time.
ARM_RESPONSE, AXIS_RESPONSE = 0.016, 0.0145  # [s]


@dataclass(frozen=True)
class RigParams:
    """The rig. ``action_delay`` [s] comes on top of the dead times of arm and axes."""

    world: WorldParams = WorldParams()
    arm: ArmParams = field(default_factory=lambda: ArmParams(comm_timeout=0.06))
    axis_profile: Literal["cmmt", "fhpp"] = "cmmt"
    axis_dead_time: Annotated[float, Within(0.0, 1.0, "s")] = 0.050
    drive: DriveParams = DriveParams(switch_on_time=0.02, homing_time=0.1)
    node_guard: Annotated[float, Within(0.01, 10.0, "s")] = 0.1
    tracker: TrackerParams = TrackerParams()
    action_delay: Annotated[float, Within(0.0, 1.0, "s")] = 0.0
    arm_network: NetworkFaults = NetworkFaults()  # both ways
    tracker_network: NetworkFaults = NetworkFaults()
    # [s] before a ball is thrown; patient: after the robot stood at home, else up to that
    pause: Annotated[float, Within(0.0, 600.0, "s")] = 0.6
    patient: bool = True
    seed: Annotated[int, Within(0, 2**31)] = 0
    hidden: HiddenErrors = HiddenErrors()

    def __post_init__(self) -> None:
        check_fields(self)


STANDARD_RIG = RigParams()


def drives_of(params: RigParams, contract: Contract) -> list[AxisEmulator]:
    """The drives of the linear axes."""
    dead_time = params.axis_dead_time + params.action_delay
    units = replace(REGISTERS[params.axis_profile].units, base_velocity=params.hidden.base_velocity)
    made = params.axis_profile, dead_time, AXIS_FEEDBACK_DELAY, params.node_guard, params.drive, units
    return [AxisEmulator(*made) for _ in contract.carrying]


def for_robot(params: RigParams, contract: Contract) -> RigParams:
    """The rig with a contract's joints, which its arm stops as fast as they may accelerate.

    Raises ValueError naming what does not fit them: another robot's limits are the contract's alone.
    """
    zeros, names = params.hidden.joint_zeros, [contract.joints[i] for i in contract.arm]
    if zeros != NOTHING_HIDDEN.joint_zeros and len(zeros) != len(names):
        raise ValueError(
            f"hidden.joint_zeros: expected {len(names)} entries for {contract.robot}, one for each of "
            f"{', '.join(names)}, got {len(zeros)}"
        )
    if contract == PAPER:
        return params
    limits, standard = contract.limits, ArmParams()
    own: dict[str, Any] = {
        name: tuple(values[i] for i in contract.arm)
        for name, values in (
            ("stop_deceleration", limits.acceleration),
            ("lower", limits.lower),
            ("upper", limits.upper),
            ("max_speed", limits.velocity),
        )
    }
    for name, values in own.items():
        if (given := getattr(params.arm, name)) not in (getattr(standard, name), values):
            raise ValueError(f"arm.{name} is {given}, allowed is nothing: those of {contract.robot} are its YAML's")
    return replace(params, arm=replace(params.arm, **own))
