"""Bounds of the parameters of a model file: wide enough for everything measured, too narrow for another unit or a
typing slip.

Nothing else is limited: programs may set what they like.
"""

from __future__ import annotations

from fnmatch import fnmatchcase

_ANY = (-float("inf"), float("inf"))
# The first pattern that fits a dotted path decides.
BOUNDS: tuple[tuple[str, tuple[float, float]], ...] = (
    ("ball.flight.mass", (1e-4, 0.1)),  # [kg]
    ("ball.flight.radius", (1e-3, 0.1)),  # [m]
    ("ball.flight.area", (1e-6, 0.1)),  # [m^2]
    ("ball.flight.air_density", (0.0, 10.0)),  # [kg/m^3]
    ("ball.flight.drag_coefficient", (0.0, 5.0)),
    ("ball.flight.magnus_coefficient", (-10.0, 10.0)),
    ("ball.flight.lift_saturation", (0.0, 100.0)),
    ("ball.flight.spin_decay", (-10.0, 100.0)),  # [1/s]
    ("ball.flight.buoyancy", (-10.0, 10.0)),
    ("ball.flight.gravity_*", (-100.0, 100.0)),  # [m/s^2]
    ("ball.flight.wind_*", (-50.0, 50.0)),  # [m/s]
    ("ball.*.restitution", (0.0, 1.5)),
    ("ball.*.restitution_slope", (-1.0, 1.0)),  # [s/m]
    ("ball.*.tangential_restitution", (-1.0, 1.0)),
    ("ball.*.friction", (0.0, 5.0)),
    ("ball.*.tangential_gain", (-2.0, 2.0)),
    ("ball.paddle.radius", (0.01, 0.5)),  # [m]
    ("ball.paddle.rim_loss", (0.0, 1.0)),
    ("ball.paddle.thickness", (0.0, 0.1)),  # [m]
    ("ball.*.height", (-0.5, 0.5)),  # [m]
    ("ball.paddle.offset", (-0.5, 0.5)),  # [m]
    ("ball.*.tilt*", (-1.0, 1.0)),  # [rad]
    ("ball_spin.std_*", (0.0, 2000.0)),  # [rad/s]
    ("ball_spin.mean_*", (-2000.0, 2000.0)),  # [rad/s]
    ("latency.*", (0.0, 1.0)),  # [s]
    ("sensing.ball_noise", (0.0, 0.5)),  # [m]
    ("sensing.ball_offset_*", (-0.5, 0.5)),  # [m]
    ("sensing.camera_rotation_*", (-1.0, 1.0)),  # [rad]
    ("sensing.camera_distortion", (-1.0, 1.0)),
    ("sensing.camera_scale", (0.5, 2.0)),
    ("sensing.clock_rate", (0.5, 2.0)),
    ("sensing.smoothing", (0.0, 1.0)),  # [s]
    ("sensing.filter_time", (0.0, 1.0)),  # [s]
    ("sensing.filter_gate", (1e-4, 10.0)),  # [m]
    ("sensing.jitter", (0.0, 0.1)),  # [s]
    ("*.velocity_gain", (-3.0, 3.0)),  # a drive that is wired the wrong way round included
    ("drives.*.joint_offset", (-3.2, 3.2)),  # [rad], [m]
    ("drives.*.*_delay", (0.0, 1.0)),  # [s]
    ("drives.*.lag", (0.0, 1.0)),  # [s]
    ("drives.*", (0.0, float("inf"))),
)


def of(path: str) -> tuple[float, float]:
    """Smallest and largest value of a parameter, by its dotted path in SimModel."""
    return next((bounds for pattern, bounds in BOUNDS if fnmatchcase(path, pattern)), _ANY)
