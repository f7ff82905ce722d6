"""Catalogue of what can be wrong with the simulated ball and its measurement: one declarative entry for each effect.

An effect is one number, its change from the nominal model, with the parameters of SimModel that express it. A new one
is one entry here, if the parameter exists. Twins are parameters that ball data can never tell from the effect itself:
they move the same products; each comes with the reading that would.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass

import numpy as np

from mjx_tt.diagnosis.description import Description

Numbers = float | np.ndarray
Values = Mapping[str, float]  # of SimModel's leaves by dotted path
Express = Callable[[Values, Numbers], dict[str, Numbers]]
FLIGHT, TABLE, PADDLE, SENSING = "ball.flight.", "ball.table.", "ball.paddle.", "sensing."


@dataclass(frozen=True, kw_only=True)
class Twin(Description):
    """A parameter whose change looks exactly like the effect's."""

    path: str
    of: Callable[[float, float], float]  # (nominal of the twin, effect's value over its nominal) -> twin's value


@dataclass(frozen=True, kw_only=True)
class Effect(Description):
    """One way in which the model may be wrong."""

    path: str  # parameter of SimModel, to which the change is added unless ``express`` is given
    scale: float  # change that would surprise nobody, in ``unit``
    express: Express | None = None  # (nominal values, change) -> values of the parameters that carry it
    path_unit: str = ""  # unit of the parameter, where it is not that of the change
    twins: tuple[Twin, ...] = ()
    step: float | None = (
        None  # of a finite difference: a fraction of the scale, unless the effect starts with a threshold
    )
    low: float = -np.inf  # smallest change that makes sense
    kinked: bool = False  # a ball that grips the table may slide a little further on
    at_paddle: bool = False  # only a hit shows it, with the joints' log beside the ball's
    needs_spin: bool = False  # shows only on balls that spin
    made_of: tuple[str, ...] = ()  # effects that it changes together: beside all of them it is no unknown of its own
    fades: bool = False  # shows for a moment only and is gone at the flight's end
    fit: bool = True  # False: not a shift of the path, found by other means
    invisible: str = ""  # reason for which no log of the ball's positions shows it

    def gone(self, without: Container[str]) -> bool:
        """True if nothing is left of the entry without these names: neither its own nor a twin's."""
        return all(name in without for name in (self.name, *(t.name for t in self.twins)))

    def values(self, nominal: Values, change: Numbers) -> dict[str, Numbers]:
        """Values of the leaves that express a change (a number or an array)."""
        if self.express is not None:
            return self.express(nominal, change)
        return {self.path: nominal[self.path] + change}


def _times(path: str) -> Express:
    return lambda nominal, change: {path: nominal[path] * (1.0 + change)}


def _tilt(axis: str) -> Express:
    return lambda nominal, change: {FLIGHT + f"gravity_{axis}": nominal[FLIGHT + f"gravity_{axis}"] + 9.81 * change}


EFFECTS: tuple[Effect, ...] = (
    Effect(
        name="drag_coefficient",
        meaning="drag of the ball",
        claim="The air brakes the ball {way:more|less} than the model says, coefficient {instead}",
        path=FLIGHT + "drag_coefficient",
        scale=0.1,
        unit="1",
        reading="a barometer, a thermometer and scales",
        twins=(
            Twin(
                name="air_density",
                meaning="thinner or denser air",
                path=FLIGHT + "air_density",
                of=lambda nominal, ratio: nominal * ratio,
                unit="kg/m^3",
                reading="a barometer and a thermometer",
            ),
            Twin(
                name="ball_mass",
                meaning="another mass of the ball",
                path=FLIGHT + "mass",
                of=lambda nominal, ratio: nominal / ratio,
                unit="kg",
                reading="scales",
            ),
            Twin(
                name="ball_radius",
                meaning="another radius of the ball",
                path=FLIGHT + "radius",
                of=lambda r, ratio: r * np.sqrt(ratio),
                unit="m",
                reading="a calliper",
            ),
        ),
    ),
    Effect(  # worded by report/text: its parameters are a distribution
        name="magnus",
        meaning="spin of the ball",
        path="ball_spin",
        scale=30.0,
        unit="rad/s",
        reading="a marked ball filmed from the side",
        fit=False,
    ),
    Effect(
        name="magnus_coefficient",
        meaning="curve of a spinning ball",
        claim="Spinning balls curve {way:more|less} than the model says, coefficient {instead}",
        path=FLIGHT + "magnus_coefficient",
        scale=0.2,
        unit="1",
        reading="a marked ball filmed from the side",
        needs_spin=True,
    ),
    # Without spin a twin of the drag; with it drag and lift change alike, which is one cause and not two.
    Effect(
        name="air_density",
        meaning="thinner or denser air",
        claim="The air is {way:denser|thinner} than the model says, {instead}",
        path=FLIGHT + "air_density",
        scale=0.05,
        express=_times(FLIGHT + "air_density"),
        unit="1",
        path_unit="kg/m^3",
        reading="a barometer and a thermometer",
        needs_spin=True,
        made_of=("drag_coefficient", "magnus_coefficient"),
        twins=(
            Twin(
                name="ball_mass",
                meaning="another mass of the ball",
                path=FLIGHT + "mass",
                of=lambda nominal, ratio: nominal / ratio,
                unit="kg",
                reading="scales",
            ),
        ),
    ),
    Effect(
        name="lift_saturation",
        meaning="lift that grows less than in proportion to spin",
        claim="The lift of fast spinning balls stays {way:further behind|closer to} proportion, saturation {instead}",
        path=FLIGHT + "lift_saturation",
        scale=3.0,
        unit="1",
        reading="balls of one speed and several spins, each marked and filmed from the side",
        needs_spin=True,
        low=0.0,
    ),
    Effect(
        name="spin_decay",
        meaning="loss of spin in flight",
        claim="The ball loses its spin {way:faster|more slowly} in flight, {instead}",
        path=FLIGHT + "spin_decay",
        scale=0.3,
        unit="1/s",
        reading="a marked ball over a long flight",
        needs_spin=True,
        low=0.0,
    ),
    Effect(
        name="wind_x",
        meaning="air that moves across the table",
        claim="The air moves sideways, towards {way:+x|-x}, at {size}",
        path=FLIGHT + "wind_x",
        scale=0.15,
        unit="m/s",
        reading="an anemometer across the table",
    ),
    Effect(
        name="wind_y",
        meaning="air that moves along the table",
        claim="The air moves along the table, towards the {way:human (+y)|robot (-y)}, at {size}",
        path=FLIGHT + "wind_y",
        scale=0.15,
        unit="m/s",
        reading="an anemometer along the table, or balls both ways",
    ),
    Effect(
        name="wind_z",
        meaning="air that rises or sinks",
        claim="The air {way:rises|sinks} at {size}",
        path=FLIGHT + "wind_z",
        scale=0.15,
        unit="m/s",
        reading="an anemometer above the table",
    ),
    Effect(
        name="gravity_tilt_x",
        meaning="a measuring frame that leans across the table",
        claim="Gravity also pulls towards {way:+x|-x}, with {size}, as if the measuring frame leaned across the table",
        path=FLIGHT + "gravity_x",
        scale=0.01,
        unit="rad",
        path_unit="m/s^2",
        reading="a spirit level on the camera's frame",
        express=_tilt("x"),
    ),
    Effect(
        name="gravity_tilt_y",
        meaning="a measuring frame that leans along the table",
        claim="Gravity also pulls towards {way:+y|-y}, with {size}, as if the measuring frame leaned along the table",
        path=FLIGHT + "gravity_y",
        scale=0.01,
        unit="rad",
        path_unit="m/s^2",
        reading="a spirit level on the camera's frame",
        express=_tilt("y"),
    ),
    Effect(
        name="gravity_scale",
        meaning="strength of gravity",
        claim="Balls fall {way:more slowly|faster} than the model says, acceleration {instead}",
        path=FLIGHT + "gravity_z",
        scale=0.02,
        unit="1",
        path_unit="m/s^2",
        reading="a ball dropped beside a ruler, timed by another clock",
        express=_times(FLIGHT + "gravity_z"),
        twins=(
            Twin(
                name="buoyancy",
                meaning="lift of the air on the ball",
                path=FLIGHT + "buoyancy",
                of=lambda b, ratio: 1.0 - (1.0 - b) * ratio,
                unit="1",
                reading="scales and a calliper",
            ),
            Twin(
                name="clock_rate",
                meaning="a clock that runs fast or slow",
                path=SENSING + "clock_rate",
                of=lambda c, ratio: c / np.sqrt(ratio),
                unit="1",
                reading="a hardware clock",
            ),
        ),
    ),
    Effect(
        name="table_restitution",
        meaning="speed that the table gives back",
        claim="The table returns {way:more|less} speed than the model says, restitution {instead}",
        path=TABLE + "restitution",
        scale=0.05,
        unit="1",
        reading="a ball dropped on the table from 30 cm",
    ),
    Effect(
        name="table_restitution_speed",
        meaning="restitution that changes with speed",
        claim="The table's restitution {way:rises|falls} with the ball's speed, {instead}",
        path=TABLE + "restitution_slope",
        scale=0.01,
        unit="s/m",
        reading="drops from 10 cm and from 2 m",
    ),
    Effect(
        name="table_friction",
        meaning="friction of the table",
        claim="The table is {way:rougher|smoother} than the model says, friction {instead}",
        path=TABLE + "friction",
        scale=0.06,
        unit="1",
        reading="flat and fast balls, or a sled on the table",
        kinked=True,
    ),
    Effect(
        name="table_grip",
        meaning="a table that springs back sideways",
        claim="A ball that the table grips springs back sideways, tangential restitution {instead}",
        path=TABLE + "tangential_restitution",
        scale=0.1,
        unit="1",
        reading="a marked ball without spin that lands steeply, filmed from the side",
        kinked=True,
        low=0.0,
    ),
    Effect(
        name="table_height",
        meaning="height of the table",
        claim="The table's surface lies {size} {way:higher|lower} than the model says",
        path=TABLE + "height",
        scale=0.005,
        unit="m",
        reading="a ruler, or a ball laid on the table",
    ),
    Effect(
        name="table_tilt_x",
        meaning="a table that leans across",
        claim="The table's surface rises towards {way:+x|-x} by {size}",
        path=TABLE + "tilt_x",
        scale=0.01,
        unit="rad",
        reading="a spirit level on the table",
    ),
    Effect(
        name="table_tilt_y",
        meaning="a table that leans along its length",
        claim="The table's surface rises towards {way:+y|-y} by {size}",
        path=TABLE + "tilt_y",
        scale=0.01,
        unit="rad",
        reading="a spirit level on the table",
    ),
    Effect(
        name="camera_scale",
        meaning="scale of the camera's calibration",
        claim="The camera measures lengths too {way:long|short}, scale {instead}",
        path=SENSING + "camera_scale",
        scale=0.01,
        unit="1",
        reading="the table's corners, 2.74 m apart",
    ),
    Effect(
        name="camera_rotation_x",
        meaning="camera frame turned about x",
        claim="The camera's frame is turned about x by {value}",
        path=SENSING + "camera_rotation_x",
        scale=0.01,
        unit="rad",
        reading="the table's corners",
    ),
    Effect(
        name="camera_rotation_y",
        meaning="camera frame turned about y",
        claim="The camera's frame is turned about y by {value}",
        path=SENSING + "camera_rotation_y",
        scale=0.01,
        unit="rad",
        reading="the table's corners",
    ),
    Effect(
        name="camera_rotation_z",
        meaning="camera frame turned about the vertical",
        claim="The camera's frame is turned about the vertical by {value}",
        path=SENSING + "camera_rotation_z",
        scale=0.01,
        unit="rad",
        reading="the table's edges",
        fit=False,
        invisible="a turn about the vertical changes no flight; the table's edges show it",
    ),
    Effect(
        name="camera_distortion",
        meaning="distortion of the camera",
        claim="The camera distorts the picture, {instead}",
        path=SENSING + "camera_distortion",
        scale=0.005,
        unit="1/m^2",
        reading="balls laid on the table's lines",
    ),
    Effect(
        name="paddle_restitution",
        meaning="speed that the paddle gives back",
        claim="The paddle gives back {way:more|less} of the ball's speed than the model says, {instead}",
        at_paddle=True,
        path=PADDLE + "restitution",
        scale=0.05,
        unit="1",
        reading="balls dropped on the clamped paddle",
    ),
    Effect(
        name="paddle_friction",
        meaning="grip of the paddle",
        claim="The rubber grips {way:more|less} than the model says, tangential gain {instead}",
        at_paddle=True,
        path=PADDLE + "tangential_gain",
        scale=0.1,
        unit="1",
        reading="spinning balls dropped on the clamped paddle",
    ),
    Effect(
        name="paddle_tilt",
        meaning="tilt of the paddle",
        claim="The blade looks {way:downwards|upwards} by {value}",
        at_paddle=True,
        path=PADDLE + "tilt",
        scale=0.02,
        unit="rad",
        reading="a protractor on the blade in the home pose",
    ),
    Effect(
        name="paddle_offset",
        meaning="place of the paddle",
        claim="The blade lies {way:ahead of|behind} where the model has it, by {size}",
        at_paddle=True,
        path=PADDLE + "offset",
        scale=0.005,
        unit="m",
        reading="a ruler from the flange to the blade",
    ),
    Effect(
        name="ball_latency",
        meaning="delay of the ball's measurement",
        claim="The ball is measured {way:later|sooner} against the joints than the model says, {instead}",
        at_paddle=True,
        path="latency.ball_observation",
        scale=0.01,
        unit="s",
        reading="a light that the camera and a joint's log both see",
        invisible="every flight looks the same later; the joint log at a paddle contact shows it",
    ),
    Effect(
        name="tracker_smoothing",
        meaning="a tracker that smooths",
        claim="The tracker smooths the ball's positions, time constant {instead}",
        path=SENSING + "smoothing",
        scale=0.008,
        unit="s",
        reading="a ball stopped by hand",
        step=0.006,
        low=0.0,
    ),
    Effect(
        name="tracker_filter",
        meaning="a tracker that predicts by constant acceleration",
        claim="The tracker filters positions by constant acceleration and is wrong behind bounces, memory {instead}",
        path=SENSING + "filter_time",
        scale=0.02,
        unit="s",
        reading="a ball that bounces, seen by the tracker and by a second camera; or the tracker's settings",
        step=0.02,
        low=0.0,
        fades=True,
    ),
    Effect(  # found by flights/tracker_gate
        name="tracker_gate",
        meaning="the surprise at which a tracker's filter starts afresh",
        claim="The tracker's filter starts afresh {way:later|earlier} than the model says, at {instead}",
        path=SENSING + "filter_gate",
        scale=0.015,
        unit="m",
        reading="the tracker's settings",
        fit=False,
    ),
    Effect(  # found by time_jitter
        name="latency_jitter",
        meaning="time stamps that scatter",
        claim="The time stamps of the ball's positions scatter by {value}",
        path=SENSING + "jitter",
        scale=0.005,
        unit="s",
        reading="a hardware trigger",
        fit=False,
    ),
)
BY_NAME = {effect.name: effect for effect in EFFECTS}
INVISIBLE = {effect.name: effect.invisible for effect in EFFECTS if effect.invisible}
DESCRIPTIONS: dict[str, Description] = {**{t.name: t for effect in EFFECTS for t in effect.twins}, **BY_NAME}
