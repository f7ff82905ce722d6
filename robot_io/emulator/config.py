"""Everything about the emulated robot, in one place."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from robot_io.contract import Contract
from robot_io.emulator import arm as arms
from robot_io.emulator.arm import ArmParams
from robot_io.emulator.axis_drive import DriveParams
from robot_io.emulator.network import FAULT_RANGES, NetworkFaults
from robot_io.emulator.tracker import TrackerParams
from robot_io.emulator.tracker.cameras import RANGES as CAMERA_RANGES
from robot_io.emulator.tracker.hidden import NOTHING_HIDDEN, HiddenErrors
from robot_io.emulator.world import WorldParams
from robot_io.ranges import check_ranges

AXIS_FEEDBACK_DELAY = 0.033  # [s], paper: latency of the linear axes' observation
# Training knows the time from a command to its effect; of the paper's 0.071 and 0.0645 s so much is no dead time.
ARM_RESPONSE, AXIS_RESPONSE = 0.016, 0.0145  # [s]

RANGES = {
    "world.timestep": (1e-4, 0.002),
    "world.drag": (0.0, 10.0),
    "world.magnus": (-1.0, 1.0),
    "world.table_restitution": (0.01, 1.0),
    "world.table_friction": (0.0, 10.0),
    "world.paddle_restitution": (0.01, 1.0),
    "world.rubber_gain": (0.0, 2.0),
    "arm.cycle": (0.001, 0.02),
    "arm.feedback_delay": (0.0, 1.0),
    "arm.dead_time": (0.0, 1.0),
    "arm.low_pass": (0.1, 1000.0),
    "arm.pos_corr_gain": (0.0, 100.0),
    "arm.comm_timeout": (0.004, 10.0),
    "arm.stop_deceleration": (0.1, 1000.0),
    "arm.lower": (-10.0, 10.0),
    "arm.upper": (-10.0, 10.0),
    "arm.max_speed": (0.01, 100.0),
    "arm.position_tolerance": (0.0, 1.0),
    "arm.overspeed": (1.0, 10.0),
    "arm.queue_length": (1, 10_000),
    "axis_dead_time": (0.0, 1.0),
    "drive.speed": (0.01, 10.0),
    "drive.acceleration": (0.1, 100.0),
    "drive.smoothing": (0.0, 1.0),
    "drive.position_gain": (0.1, 1000.0),
    "drive.following_error": (0.001, 10.0),
    "drive.switch_on_time": (0.0, 60.0),
    "drive.homing_time": (0.0, 60.0),
    "node_guard": (0.01, 10.0),
    "tracker.rate": (10.0, 1000.0),
    "tracker.latency": (0.0, 1.0),
    "tracker.noise": (0.0, 1.0),
    "tracker.offset": (-1.0, 1.0),
    **{f"{side}_network.{name}": bounds for side in ("arm", "tracker") for name, bounds in FAULT_RANGES.items()},
    **CAMERA_RANGES,
    "action_delay": (0.0, 1.0),
    "pause": (0.0, 600.0),
    "seed": (0, 2**31),
    "hidden.camera_position": (-5.0, 5.0),
    "hidden.camera_angles": (-1.5, 1.5),
    "hidden.joint_zeros": (-0.05, 0.05),
    "hidden.clock_offset": (-1e6, 1e6),
    "hidden.clock_drift": (-1e-3, 1e-3),
}


@dataclass(frozen=True)
class RigParams:
    """The rig. ``action_delay`` [s] comes on top of the dead times of arm and axes."""

    world: WorldParams = WorldParams()
    arm: ArmParams = field(default_factory=lambda: ArmParams(comm_timeout=0.06))
    axis_profile: str = "cmmt"
    axis_dead_time: float = 0.050
    drive: DriveParams = DriveParams(switch_on_time=0.02, homing_time=0.1)
    node_guard: float = 0.1
    tracker: TrackerParams = TrackerParams()
    action_delay: float = 0.0
    arm_network: NetworkFaults = NetworkFaults()  # both ways
    tracker_network: NetworkFaults = NetworkFaults()
    pause: float = 0.6  # [s] before a ball is thrown; patient: after the robot stood at home, else up to that
    patient: bool = True
    seed: int = 0
    hidden: HiddenErrors = HiddenErrors()

    def __post_init__(self) -> None:
        check_ranges(self, RANGES)


STANDARD_RIG = RigParams()


def for_robot(params: RigParams, contract: Contract) -> RigParams:
    """The rig with a contract's joints. Raises ValueError naming what does not fit them."""
    zeros, names = params.hidden.joint_zeros, [contract.joints[i] for i in contract.arm]
    if zeros != NOTHING_HIDDEN.joint_zeros and len(zeros) != len(names):
        raise ValueError(
            f"hidden.joint_zeros: got {len(zeros)} entries; allowed: {len(names)} for {contract.robot}, "
            f"{', '.join(names)}"
        )
    return replace(params, arm=arms.for_robot(params.arm, contract))
