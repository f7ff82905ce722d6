"""Frames, shapes and states for viewers such as Foxglove and Lichtblick, beside the measurements.

Made by the process that writes the file, from records that are there anyway, so it costs the control loop nothing.
Frames are named after the robot's joints and stand as in its safety geometry; the ball has a frame of its own.
``layout.json`` arranges it all, ``layout`` for another robot than the paper's.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from importlib import resources
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from scipy.spatial.transform import Rotation

from ballmodel import constants
from robot_io.calibrated import Frame
from robot_io.contract import PAPER, Contract
from robot_io.log.messages import Ball, Event, Joints, Record
from robot_io.log.topics import FRAME, Encoded, Topic
from robot_io.safety.clearance import FIXED, SHIPPED

HERE = Frame()
RATE = 30.0  # [1/s] of the robot's frames; viewers interpolate
BALL_RATE = 70.0  # [1/s] of the ball's
BALL_FRAME = "ball"
LINE = 0.02  # [m] width of the table's lines
BLADE_THICKNESS = 0.012  # [m] as drawn
BLUE, WHITE, GREY, STEEL = (0.05, 0.27, 0.52, 1.0), (1.0, 1.0, 1.0, 1.0), (0.3, 0.3, 0.3, 0.5), (0.7, 0.72, 0.75, 1.0)
ORANGE, RED = (1.0, 0.5, 0.0, 1.0), (0.75, 0.1, 0.1, 1.0)

UNTURNED = Rotation.identity()
NOTHING = '{"joints": [], "capsules": [], "blade_capsules": []}'  # geometry of a robot that is not drawn

TF = Topic("/tf", FrameTransforms, {})
SCENE = Topic("/scene", SceneUpdate, {})
STATE = Topic("/state", KeyValuePair, {})
TOPICS = (TF, SCENE, STATE)


class View:
    """Messages for viewers, from the records of one session in their order.

    base   where the robot stands, from where the model has it
    robot  without a geometry in its contract it is not drawn
    """

    def __init__(self, base: Frame = HERE, robot: Contract = PAPER) -> None:
        self._base, self._turned = base, Rotation.from_matrix(base.matrix)
        shipped = (resources.files("robot_io.safety") / SHIPPED).read_text(encoding="utf-8")
        geometry = json.loads(shipped if robot == PAPER else robot.geometry or NOTHING)
        self._joints, self._blade = geometry["joints"], geometry["blade_capsules"]
        self._fixed = [Rotation.from_matrix(joint["rot"]) for joint in self._joints]
        self._capsules = geometry["capsules"]
        self._due = {Joints: -math.inf, Ball: -math.inf}

    def scene(self, time: float) -> Encoded:
        """Table, robot and ball, each in its frame; for the session's start."""
        update = SceneUpdate()
        _draw_table(update.entities.add(id="table", frame_id=FRAME))
        ball = update.entities.add(id=BALL_FRAME, frame_id=BALL_FRAME)
        _add(ball.spheres, (0.0, 0.0, 0.0), (constants.BALL_DIAMETER,) * 3, ORANGE)
        links = {j["name"]: update.entities.add(id=j["name"], frame_id=j["name"]) for j in self._joints}
        for capsule in self._capsules:
            if capsule["name"] in self._blade:
                continue
            p, q = np.array(capsule["p0"], float), np.array(capsule["p1"], float)
            if capsule["joint"] == FIXED:
                p, q = self._base.outward(p), self._base.outward(q)
                if FIXED not in links:
                    links[FIXED] = update.entities.add(id=FIXED, frame_id=FRAME)
            link, width = links[capsule["joint"]], 2.0 * capsule["radius"]
            _add_cylinder(link, 0.5 * (p + q), q - p, width, math.dist(p, q), STEEL)
            for end in (p, q):
                _add(link.spheres, end, (width,) * 3, STEEL)
        blade = [capsule for name in self._blade for capsule in self._capsules if capsule["name"] == name]
        if blade:
            middle = 0.5 * (np.array(blade[0]["p0"]) + np.array(blade[0]["p1"]))
            link = links[blade[0]["joint"]]
            _add_cylinder(link, middle, _normal(blade), 2.0 * constants.PADDLE_RADIUS, BLADE_THICKNESS, RED)
        for entity in update.entities:
            entity.frame_locked = True
        return Encoded(SCENE, time, time, 0, update)

    def encode(self, record: Record) -> Iterator[Encoded]:
        """Messages that follow from a record; never raises."""
        if isinstance(record, Joints):
            drawn = self._joints and np.isfinite(record.position).all()
            if self._is_due(record, record.time, RATE) and drawn:
                yield Encoded(TF, record.log_time, record.time, 0, self._frames(record.position.tolist()))
        elif isinstance(record, Ball):
            if self._is_due(record, record.capture_time, BALL_RATE) and np.isfinite(record.position).all():
                message = FrameTransforms()
                _add_frame(message, FRAME, BALL_FRAME, record.position)
                yield Encoded(TF, record.received, record.capture_time, record.id, message)
        elif isinstance(record, Event) and (value := _state(record)):
            yield Encoded(STATE, record.time, record.time, 0, KeyValuePair(key="state", value=value))

    def _is_due(self, record: Joints | Ball, time: float, rate: float) -> bool:
        due = self._due[type(record)]
        if due - 1.0 < time < due:  # times that jump back begin anew
            return False
        self._due[type(record)] = time + 1.0 / rate
        return True

    def _frames(self, position: Sequence[float]) -> FrameTransforms:
        message, parent = FrameTransforms(), FRAME
        for joint, turned, q in zip(self._joints, self._fixed, position, strict=True):
            place, axis = np.array(joint["pos"], float), np.array(joint["axis"], float)
            if joint["type"] == "slide":
                place = place + turned.apply(q * axis)
            else:
                turned = turned * Rotation.from_rotvec(q * axis)
            if parent == FRAME:
                place, turned = self._base.outward(place), self._turned * turned
            _add_frame(message, parent, joint["name"], place, turned)
            parent = joint["name"]
        return message


def layout(robot: Contract) -> dict[str, Any]:
    """``layout.json`` with a robot's joints in the plot of the commands."""
    shipped = json.loads((resources.files("robot_io.log") / "layout.json").read_text(encoding="utf-8"))
    plot = shipped["configById"]["Plot!commands"]
    line = plot["paths"][0]
    plot["paths"] = [
        line | {"value": f"/commands/sent.joints[{i}].velocity", "label": f"{name} sent"}
        for i, name in enumerate(robot.joints)
    ]
    return shipped


def _state(event: Event) -> str | None:
    """The state that begins with an event; None where none does."""
    if event.name not in ("state", "fault"):
        return None
    try:
        details = json.loads(event.text)
        if event.name == "fault":
            return f"fault: {details['cause']}"
        return None if details["why"].startswith("fault: ") else str(details["to"])
    except (ValueError, LookupError, TypeError, AttributeError):
        return None


def _add_frame(message: Any, parent: str, child: str, place: Any, turned: Rotation = UNTURNED) -> None:
    message.transforms.add(
        parent_frame_id=parent, child_frame_id=child, translation=_vector(place), rotation=_quaternion(turned)
    )


def _draw_table(table: SceneEntity) -> None:
    half_x, half_y = 0.5 * (constants.TABLE_WIDTH - LINE), 0.5 * (constants.TABLE_LENGTH - LINE)
    lines = [
        (-half_x, 0.0, LINE, constants.TABLE_LENGTH),
        (0.0, 0.0, 0.003, constants.TABLE_LENGTH),
        (half_x, 0.0, LINE, constants.TABLE_LENGTH),
    ]
    lines += [(0.0, -half_y, constants.TABLE_WIDTH, LINE), (0.0, half_y, constants.TABLE_WIDTH, LINE)]
    leg, middle = (
        constants.TABLE_HEIGHT - constants.TABLE_THICKNESS,
        -0.5 * (constants.TABLE_HEIGHT + constants.TABLE_THICKNESS),
    )
    shapes = (
        (
            (0.0, 0.0, -0.5 * constants.TABLE_THICKNESS),
            (constants.TABLE_WIDTH, constants.TABLE_LENGTH, constants.TABLE_THICKNESS),
            BLUE,
        ),
        *(((x, y, 0.0), (width, length, 0.002), WHITE) for x, y, width, length in lines),
        (
            (0.0, 0.0, 0.5 * constants.NET_HEIGHT),
            (constants.TABLE_WIDTH + 2 * constants.NET_OVERHANG, constants.NET_THICKNESS, constants.NET_HEIGHT),
            GREY,
        ),
        *(((x, y, middle), (0.05, 0.05, leg), GREY) for x in (-0.6, 0.6) for y in (-1.05, 1.05)),
    )
    for shape in shapes:
        _add(table.cubes, *shape)


def _add(shapes: Any, place: Any, size: Any, colour: Sequence[float], turned: Rotation = UNTURNED) -> Any:
    pose = {"position": _vector(place), "orientation": _quaternion(turned)}
    return shapes.add(pose=pose, size=_vector(size), color=dict(zip("rgba", colour, strict=True)))


def _add_cylinder(
    entity: SceneEntity, place: Any, axis: np.ndarray, diameter: float, length: float, colour: Sequence[float]
) -> None:
    turned, _ = Rotation.align_vectors([axis], [[0.0, 0.0, 1.0]])
    cylinder = _add(entity.cylinders, place, (diameter, diameter, length), colour, turned)
    cylinder.bottom_scale = cylinder.top_scale = 1.0


def _vector(values: Any) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


def _quaternion(turned: Rotation) -> dict[str, float]:
    return dict(zip("xyzw", turned.as_quat(), strict=True))


def _normal(blade: Sequence[dict[str, Any]]) -> np.ndarray:
    """Direction across the blade: across its first two capsules, or whatever lies across the only one."""
    first, second = (np.subtract(capsule["p1"], capsule["p0"]) for capsule in (blade[0], blade[-1]))
    normal = np.cross(first, second)
    return normal if normal.any() else np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
