"""The YAML that describes a robot of one's own: what its MJCF does not say.

    name: my_arm
    mjcf: my_arm.xml           beside the YAML
    paddle: paddle             site at the blade's centre: x along the handle, z out of the striking face
    carrying: [rail]           linear axes that carry the arm; [] for a fixed base
    joints:                    from the base to the paddle
      rail: {range: [-1, 1], velocity: 2, acceleration: 15, margin: 0.01, policy_velocity: 2, home: 0}
      ...
    mount: {position: [0, -2, -0.38], yaw: 0}     of the MJCF's origin on the floor plan [m], [rad]
    latencies: {arm_action: [0.071, 0.0057]}      mean and deviation [s]
    drives: {rail: {lag: 0.01}}                   as the drives of a model YAML
    clearance:                 capsules (geoms named col_...) and what they must not touch
      table: [col_forearm, col_blade]
      blade: [col_blade]
      pairs: [[col_base, col_blade]]

``mjx_tt.robot.robots`` adds the MJCF; the control process knows a robot by its contract and does not read this file.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Field, model_validator

from ballmodel.io.ranges import Within
from ballmodel.io.validation import Finite, Positive, Section, validate
from robot_io.contract import Contract
from robot_io.limits import JointLimits

Text = Annotated[str, Field(pattern=r"\S")]
Seconds = Annotated[float, Within(0.0, 1.0, "s")]
Latency = tuple[Seconds, Seconds]  # mean and deviation
LATENCIES = {  # key of the YAML: that of a model YAML
    "ball_observation": "ball_observation",
    "arm_observation": "abb_observation",
    "carrying_observation": "festo_observation",
    "arm_action": "abb_action",
    "carrying_action": "festo_action",
}
MOST_TURNS = 4.0  # of a hinge to either side: a larger range is in degrees


class Joint(Section):
    """A joint, in m if it is listed under carrying, else in rad."""

    range: tuple[Finite, Finite]
    """Lower and upper end."""
    velocity: Positive
    """Highest speed [1/s]."""
    acceleration: Positive
    """Highest commanded acceleration [1/s^2]."""
    margin: Annotated[float, Within(0.0)]
    """Distance that is kept from both ends."""
    policy_velocity: Positive
    """Velocity that an action of 1 asks for."""
    home: Finite
    """Position at which episodes begin."""

    @model_validator(mode="after")
    def _check_range(self) -> Joint:
        (lower, upper), margin = self.range, self.margin
        if not lower < upper:
            raise ValueError(f"range: expected a lower end below the upper, got {[lower, upper]}")
        low, high = lower + margin, upper - margin
        if low < high and not low < self.home < high:
            raise ValueError(
                f"home: expected a position inside the range less its margin, {low:g} to {high:g}, got {self.home}"
            )
        return self


class Mount(Section):
    """Where the MJCF's origin stands in the table's frame."""

    position: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """[m]."""
    yaw: Finite = 0.0
    """[rad]."""


class Latencies(Section):
    """Mean and deviation of each latency [s]; null: the paper's."""

    ball_observation: Latency | None = None
    """From the ball's capture to the policy."""
    arm_observation: Latency | None = None
    """From the arm's position to the policy."""
    carrying_observation: Latency | None = None
    """From the position of the carrying axes to the policy."""
    arm_action: Latency | None = None
    """From a command to its effect on the arm."""
    carrying_action: Latency | None = None
    """From a command to its effect on the carrying axes."""


class Clearance(Section):
    """Capsules, geoms of the MJCF, and what they must not touch."""

    table: list[str]
    """Capsules that are kept from the table and the floor."""
    blade: Annotated[list[str], Field(min_length=1)]
    """Those of them that are the blade."""
    pairs: list[tuple[str, str]]
    """Pairs that are kept from each other."""

    @model_validator(mode="after")
    def _check_names(self) -> Clearance:
        for key, names in (("table", self.table), ("blade", self.blade), *(("pairs", pair) for pair in self.pairs)):
            if len(set(names)) < len(names):
                raise ValueError(f"{key}: expected different capsules, got {list(names)}")
        for name in self.blade:
            if name not in self.table:
                raise ValueError(f"blade: expected capsules of table, {', '.join(self.table)}, got {name!r}")
        return self


class Description(Section):
    """The YAML of a robot."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")]
    """Name of the robot: letters, digits, _ and -."""
    mjcf: Text
    """File of the MJCF, beside the YAML, or the MJCF itself."""
    paddle: Text
    """Site at the blade's centre: x along the handle, z out of the striking face."""
    carrying: list[str]
    """Linear axes that carry the arm; [] for a fixed base."""
    joints: Annotated[dict[str, Joint], Field(min_length=1)]
    """Every joint, from the base to the paddle."""
    mount: Mount = Mount()
    """Where the MJCF's origin stands."""
    latencies: Latencies = Latencies()
    """Latencies of the robot and its tracker."""
    drives: dict[str, dict[str, Finite]] = {}
    """By joint, what its drive does, as in a model YAML."""
    clearance: Clearance
    """What the robot must not touch."""

    @model_validator(mode="after")
    def _check_joints(self) -> Description:
        if mistakes := list(self._mistakes()):
            raise ValueError("\n".join(mistakes))
        return self

    def _mistakes(self) -> Iterator[str]:
        for key, names in (("carrying", self.carrying), ("drives", self.drives)):
            for name in names:
                if name not in self.joints:
                    yield f"{key}: expected joints, {', '.join(self.joints)}, got {name!r}"
        if len(set(self.carrying)) < len(self.carrying):
            yield f"carrying: expected different joints, got {self.carrying}"
        for name, joint in self.joints.items():
            if name not in self.carrying and max(map(abs, joint.range)) > 2.0 * math.pi * MOST_TURNS:
                yield (
                    f"joints.{name}.range: expected radians, not degrees, at most {MOST_TURNS:g} turns, "
                    f"got {list(joint.range)}"
                )

    def model_values(self, latencies: Iterable[str]) -> Iterator[tuple[str, float]]:
        """What the simulation's model gets: dotted path of a model YAML and value; ``latencies`` in their order."""
        for key in latencies:
            if (latency := getattr(self.latencies, key)) is not None:
                yield f"latency.{LATENCIES[key]}", latency[0]
                yield f"latency.{LATENCIES[key]}_std", latency[1]
        for joint, drive in self.drives.items():
            yield from ((f"drives.{joint}.{effect}", value) for effect, value in drive.items())


@dataclass(frozen=True)
class RobotFile:
    """Content of the YAML.

    mjcf                 as it stands there: a file's name, or the MJCF itself
    paddle               the site
    contract             without geometry, which needs the MJCF
    home                 joint positions [m], [rad]
    position, yaw        of the mounting [m], [rad]
    model                what the simulation's model gets: dotted path of a model YAML and value, in the file's order
    table, blade, pairs  names of capsules
    """

    name: str
    mjcf: str
    paddle: str
    contract: Contract
    home: tuple[float, ...]
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    model: tuple[tuple[str, float], ...] = ()
    table: tuple[str, ...] = ()
    blade: tuple[str, ...] = ()
    pairs: tuple[tuple[str, str], ...] = ()


def parse(data: Any, where: str) -> RobotFile:
    """The content of parsed YAML. Raises ValueError with a line for every mistake: file, key, expected and given."""
    file = validate(Description, data, where)
    joints = file.joints
    columns = {
        key: tuple(getattr(joint, key) for joint in joints.values())
        for key in ("velocity", "acceleration", "margin", "policy_velocity")
    }
    lower, upper = zip(*(joint.range for joint in joints.values()), strict=True)
    try:
        limits = JointLimits(lower=lower, upper=upper, joints=tuple(joints), **columns)
    except ValueError as error:  # begins with the joint
        raise ValueError(f"{where}: joints.{error}") from None
    units = tuple("m" if joint in file.carrying else "rad" for joint in joints)
    carrying = tuple(i for i, joint in enumerate(joints) if joint in file.carrying)
    return RobotFile(
        name=file.name,
        mjcf=file.mjcf,
        paddle=file.paddle,
        contract=Contract(file.name, units, carrying, limits),
        home=tuple(joint.home for joint in joints.values()),
        position=file.mount.position,
        yaw=file.mount.yaw,
        model=tuple(file.model_values(data.get("latencies", ()))),
        table=tuple(file.clearance.table),
        blade=tuple(file.clearance.blade),
        pairs=tuple(file.clearance.pairs),
    )
