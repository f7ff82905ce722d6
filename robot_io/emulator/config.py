"""Everything about the emulated robot, in one place."""

from __future__ import annotations

from dataclasses import dataclass, field

from robot_io.devices.festo import AxesConfig
from robot_io.emulator.arm import ArmParams
from robot_io.emulator.axis_drive import DriveParams
from robot_io.emulator.network import NetworkFaults
from robot_io.emulator.tracker import TrackerParams
from robot_io.emulator.world import WorldParams

# The latency that training knows and the lag of the carriage's servo behind it.
AXES_CONFIG = AxesConfig(latency=0.0645 + 0.033 + 0.035, gain=2.0)
AXIS_FEEDBACK_DELAY = 0.033  # [s], paper: latency of the linear axes' observation


@dataclass(frozen=True)
class RigParams:
    """The rig. ``action_delay`` [s] comes on top of the dead times of arm and axes."""

    world: WorldParams = WorldParams()
    arm: ArmParams = field(default_factory=lambda: ArmParams(comm_timeout=0.06))
    axis_profile: str = "cmmt"
    axis_dead_time: float = 0.050
    # A position controller as stiff as the carriage, a velocity servo with a lag of 35 ms, bears without overshoot.
    drive: DriveParams = DriveParams(switch_on_time=0.02, homing_time=0.1, position_gain=2.0, following_error=0.15)
    node_guard: float = 0.1
    tracker: TrackerParams = TrackerParams()
    action_delay: float = 0.0
    arm_network: NetworkFaults = NetworkFaults()  # both ways
    tracker_network: NetworkFaults = NetworkFaults()
    pause: float = 0.6  # [s] of the thrower
    seed: int = 0
