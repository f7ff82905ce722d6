"""What can be wrong with the simulated ball and its measurement: one small declarative entry for each effect.

An effect is one number, its change from the nominal model, and says which parameters of SimModel express it. A new one
is one line here, if the parameter exists. Twins are parameters that ball data can never tell from the effect itself:
they move the same products; each comes with the reading that would.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

AT_THE_PADDLE = "paddle"  # group of the effects that only a hit shows, with the joints' log beside the ball's
Values = Mapping[str, float]  # of SimModel's leaves by dotted path
FLIGHT, TABLE, PADDLE, SENSING = "ball.flight.", "ball.table.", "ball.paddle.", "sensing."


@dataclass(frozen=True)
class Twin:
    """A parameter whose change looks exactly like the effect's."""

    name: str
    path: str
    of: Callable[[float, float], float]  # (nominal of the twin, effect's value over its nominal) -> twin's value
    unit: str
    reading: str


@dataclass(frozen=True)
class Effect:
    """One way in which the model may be wrong.

    ``scale`` is a change that would surprise nobody, in ``unit``; ``step`` what a finite difference moves it by (a
    fraction of the scale, unless the effect starts with a threshold). ``express`` maps nominal values and the change
    to the values of the parameters that carry it; by default the change is added to ``path``.
    """

    name: str
    group: str
    path: str
    scale: float
    unit: str
    reading: str  # the measurement that would settle it
    express: Callable[[Values, float], dict] | None = None
    twins: tuple[Twin, ...] = ()
    step: float | None = None
    low: float = -np.inf  # smallest change that makes sense
    needs_spin: bool = False  # shows only on balls that spin
    fit: bool = True  # False: not a shift of the path, found by other means

    def gone(self, without) -> bool:
        """Whether nothing is left of the entry when these names are left out: neither its own nor a twin's."""
        return all(name in without for name in (self.name, *(t.name for t in self.twins)))

    def values(self, nominal: Values, change) -> dict:
        """Values of the leaves that express a change (a number or an array)."""
        if self.express is not None:
            return self.express(nominal, change)
        return {self.path: nominal[self.path] + change}


def _times(path: str):
    return lambda nominal, change: {path: nominal[path] * (1.0 + change)}


def _tilt(axis: str):
    return lambda nominal, change: {FLIGHT + f"gravity_{axis}": nominal[FLIGHT + f"gravity_{axis}"] + 9.81 * change}


def _same(nominal, ratio):
    return nominal * ratio


def _inverse(nominal, ratio):
    return nominal / ratio


EFFECTS: tuple[Effect, ...] = (
    Effect(
        "drag_coefficient",
        "ball",
        FLIGHT + "drag_coefficient",
        0.05,
        "1",
        "a barometer, a thermometer and scales",
        twins=(
            Twin("air_density", FLIGHT + "air_density", _same, "kg/m^3", "a barometer and a thermometer"),
            Twin("ball_mass", FLIGHT + "mass", _inverse, "kg", "scales"),
            Twin("ball_radius", FLIGHT + "radius", lambda r, ratio: r * np.sqrt(ratio), "m", "a calliper"),
        ),
    ),
    Effect("magnus", "ball", "ball_spin", 30.0, "rad/s", "a marked ball filmed from the side", fit=False),
    Effect(
        "magnus_coefficient",
        "ball",
        FLIGHT + "magnus_coefficient",
        0.2,
        "1",
        "a marked ball filmed from the side",
        needs_spin=True,
    ),
    Effect(
        "spin_decay", "ball", FLIGHT + "spin_decay", 0.3, "1/s", "a marked ball over a long flight", needs_spin=True
    ),
    Effect("wind_x", "ball", FLIGHT + "wind_x", 0.3, "m/s", "an anemometer across the table"),
    Effect("wind_y", "ball", FLIGHT + "wind_y", 0.3, "m/s", "an anemometer along the table, or balls both ways"),
    Effect("wind_z", "ball", FLIGHT + "wind_z", 0.3, "m/s", "an anemometer above the table"),
    Effect(
        "gravity_tilt_x", "ball", FLIGHT + "gravity_x", 0.01, "rad", "a spirit level on the camera's frame", _tilt("x")
    ),
    Effect(
        "gravity_tilt_y", "ball", FLIGHT + "gravity_y", 0.01, "rad", "a spirit level on the camera's frame", _tilt("y")
    ),
    Effect(
        "gravity_scale",
        "ball",
        FLIGHT + "gravity_z",
        0.02,
        "1",
        "a ball dropped beside a ruler, timed by another clock",
        _times(FLIGHT + "gravity_z"),
        twins=(
            Twin(
                "buoyancy", FLIGHT + "buoyancy", lambda b, ratio: 1.0 - (1.0 - b) * ratio, "1", "scales and a calliper"
            ),
            Twin("clock_rate", SENSING + "clock_rate", lambda c, ratio: c / np.sqrt(ratio), "1", "a hardware clock"),
        ),
    ),
    Effect("table_restitution", "bounce", TABLE + "restitution", 0.03, "1", "a ball dropped on the table from 30 cm"),
    Effect(
        "table_restitution_speed", "bounce", TABLE + "restitution_slope", 0.01, "s/m", "drops from 10 cm and from 2 m"
    ),
    Effect("table_friction", "bounce", TABLE + "friction", 0.06, "1", "flat and fast balls, or a sled on the table"),
    Effect("table_height", "bounce", TABLE + "height", 0.005, "m", "a ruler, or a ball laid on the table"),
    Effect("table_tilt_x", "bounce", TABLE + "tilt_x", 0.01, "rad", "a spirit level on the table"),
    Effect("table_tilt_y", "bounce", TABLE + "tilt_y", 0.01, "rad", "a spirit level on the table"),
    Effect("camera_scale", "sensing", SENSING + "camera_scale", 0.02, "1", "the table's corners, 2.74 m apart"),
    Effect("camera_rotation_x", "sensing", SENSING + "camera_rotation_x", 0.01, "rad", "the table's corners"),
    Effect("camera_rotation_y", "sensing", SENSING + "camera_rotation_y", 0.01, "rad", "the table's corners"),
    Effect("camera_rotation_z", "sensing", SENSING + "camera_rotation_z", 0.01, "rad", "the table's edges", fit=False),
    Effect(
        "camera_distortion", "sensing", SENSING + "camera_distortion", 0.005, "1/m^2", "balls laid on the table's lines"
    ),
    Effect("paddle_restitution", "paddle", PADDLE + "restitution", 0.05, "1", "balls dropped on the clamped paddle"),
    Effect(
        "paddle_friction",
        "paddle",
        PADDLE + "tangential_gain",
        0.1,
        "1",
        "spinning balls dropped on the clamped paddle",
    ),
    Effect("paddle_tilt", "paddle", PADDLE + "tilt", 0.02, "rad", "a protractor on the blade in the home pose"),
    Effect("paddle_offset", "paddle", PADDLE + "offset", 0.005, "m", "a ruler from the flange to the blade"),
    Effect(
        "ball_latency",
        "paddle",
        "latency.ball_observation",
        0.01,
        "s",
        "a light that the camera and a joint's log both see",
    ),
    Effect(
        "tracker_smoothing", "sensing", SENSING + "smoothing", 0.008, "s", "a ball stopped by hand", step=0.006, low=0.0
    ),
)
BY_NAME = {effect.name: effect for effect in EFFECTS}
# What no log of the ball's positions shows, with why; the last one only without the joints' log.
INVISIBLE = {
    "camera_rotation_z": "a turn about the vertical changes no flight; the table's edges show it",
    "ball_latency": "every flight looks the same later; the joint log at a paddle contact shows it",
}
