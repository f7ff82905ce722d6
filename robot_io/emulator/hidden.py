"""Errors of an installation that nobody told the bridge of: what a calibration has to find.

Written without ``robot_io.calibrated`` on purpose: angles about fixed axes here, rotation vectors there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from ballmodel.io.ranges import Within

if TYPE_CHECKING:
    from robot_io.emulator.arm import ArmController
    from robot_io.emulator.axes import AxisEmulator

Metres = Annotated[float, Within(-5.0, 5.0, "m")]
Radians = Annotated[float, Within(-3.1416, 3.1416, "rad")]

Factor = Annotated[float, Within(-10.0, 10.0)]
Zero = Annotated[float, Within(-1.0, 1.0, "m")]
Scale = Annotated[float, Within(-1000.0, 1000.0)]


@dataclass(frozen=True)
class HiddenErrors:
    """Differences between the rig and what the bridge is told of it.

    camera_position  [m] of the tracker's origin in the table frame
    camera_angles    [rad] by which its axes are turned about the table's x, then y, then z axis
    camera_scale     that it gives of each metre along its axes: -1 mirrors one, 1000 are millimetres
    joint_zeros      [rad] of the arm's joints, six of the paper's robot: true angle where its controller reports 0
    clock_offset     [s] that the tracker's clock shows when the bridge's shows 0
    clock_drift      seconds per second that the tracker's clock gains
    joint_order      of the arm's joints, as the controller counts them; empty: as they are
    axis_factor      metres that each linear axis's drive counts for one of its carriage, not 0: -1 runs the other way
    axis_zero        [m] that its drive reads too much once it is homed
    base_velocity    [m/s] that the drives' 100 % stand for
    stop_wired       the emergency stop takes the power from arm and axes
    """

    camera_position: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    camera_angles: tuple[Radians, Radians, Radians] = (0.0, 0.0, 0.0)
    camera_scale: tuple[Scale, Scale, Scale] = (1.0, 1.0, 1.0)
    joint_zeros: tuple[Annotated[float, Within(-0.05, 0.05, "rad")], ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    clock_offset: Annotated[float, Within(-1e6, 1e6, "s")] = 0.0
    clock_drift: Annotated[float, Within(-0.02, 0.02)] = 0.0
    joint_order: tuple[Annotated[int, Within(0, 11)], ...] = ()
    axis_factor: tuple[Factor, Factor] = (1.0, 1.0)
    axis_zero: tuple[Zero, Zero] = (0.0, 0.0)
    base_velocity: Annotated[float, Within(0.01, 100.0, "m/s")] = 2.0
    stop_wired: bool = True

    def seen(self, point: np.ndarray) -> np.ndarray:
        """Coordinates (3,) that the tracker gives to a point (3,) of the table frame [m]."""
        x, y, z = point - np.array(self.camera_position)
        a, b, c = (-angle for angle in self.camera_angles)  # undone in the opposite order
        x, y = x * np.cos(c) - y * np.sin(c), x * np.sin(c) + y * np.cos(c)
        x, z = x * np.cos(b) + z * np.sin(b), z * np.cos(b) - x * np.sin(b)
        y, z = y * np.cos(a) - z * np.sin(a), y * np.sin(a) + z * np.cos(a)
        return np.array([x, y, z]) * self.camera_scale

    def stamped(self, now: float) -> float:
        """Time [s] on the tracker's clock at ``now`` on the bridge's."""
        return now + self.clock_offset + self.clock_drift * now if self.clock_offset or self.clock_drift else now

    def counted(self, angles: np.ndarray) -> np.ndarray:
        """Angles (n,) [rad] of which the arm's controller knows where the joints are at ``angles``."""
        angles = angles - np.array(self.joint_zeros) if any(self.joint_zeros) else angles
        return angles[list(self.joint_order)] if self.joint_order else angles

    def drive_arm(
        self, arm: ArmController, now: float, position: np.ndarray, velocity: np.ndarray
    ) -> tuple[np.ndarray, bytes | None]:
        """One cycle of the arm's controller at the joints' (n,) [rad], [rad/s]; their new velocities, its datagram."""
        order = list(self.joint_order or range(len(position)))
        commanded, datagram = arm.step(now, self.counted(position), velocity[order])
        return commanded[np.argsort(order)], datagram

    def drive_axis(self, axis: int, emulator: AxisEmulator, now: float, position: float, velocity: float) -> float:
        """One step of a linear axis's drive at its carriage's position [m] and velocity [m/s]; its new velocity."""
        factor, zero = (values[min(axis, 1)] for values in (self.axis_factor, self.axis_zero))
        return emulator.step(now, factor * position + zero, factor * velocity) / factor


NOTHING_HIDDEN = HiddenErrors()
