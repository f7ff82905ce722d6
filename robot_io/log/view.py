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

from ballmodel.constants import (
    BALL_DIAMETER,
    NET_HEIGHT,
    NET_OVERHANG,
    NET_THICKNESS,
    PADDLE_RADIUS,
    TABLE_HEIGHT,
    TABLE_LENGTH,
    TABLE_THICKNESS,
    TABLE_WIDTH,
)
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

NOTHING = '{"joints": [], "capsules": [], "blade_capsules": []}'  # geometry of a robot that is not drawn

TF = Topic("/tf", FrameTransforms)
SCENE = Topic("/scene", SceneUpdate)
STATE = Topic("/state", KeyValuePair)
TOPICS = {topic.name: topic for topic in (TF, SCENE, STATE)}


class View:
    """Messages for viewers, from the records of one session in their order.

    base   where the robot stands, from where the model has it
    robot  without a geometry in its contract it is not drawn
    """

    def __init__(self, base: Frame = HERE, robot: Contract = PAPER) -> None:
        self._base, self._turned = base, _quaternion(base.matrix)
        shipped = (resources.files("robot_io.safety") / SHIPPED).read_text(encoding="utf-8")
        geometry = json.loads(shipped if robot == PAPER else robot.geometry or NOTHING)
        self._joints, self._blade = geometry["joints"], geometry["blade_capsules"]
        self._fixed = [_quaternion(np.array(joint["rot"], float)) for joint in self._joints]
        self._capsules = geometry["capsules"]
        self._due = {Joints: -math.inf, Ball: -math.inf}

    def scene(self, time: float) -> Encoded:
        """Table, robot and ball, each in its frame; for the session's start."""
        update = SceneUpdate()
        _table(update.entities.add(id="table", frame_id=FRAME))
        ball = update.entities.add(id=BALL_FRAME, frame_id=BALL_FRAME)
        _sphere(ball, (0.0, 0.0, 0.0), BALL_DIAMETER, ORANGE)
        links = {j["name"]: update.entities.add(id=j["name"], frame_id=j["name"]) for j in self._joints}
        for capsule in self._capsules:
            if capsule["name"] in self._blade:
                continue
            p, q = capsule["p0"], capsule["p1"]
            if capsule["joint"] == FIXED:
                p, q = (self._base.outward(np.array(end)).tolist() for end in (p, q))
                links.setdefault(FIXED, update.entities.add(id=FIXED, frame_id=FRAME))
            link, width = links[capsule["joint"]], 2.0 * capsule["radius"]
            _cylinder(link, *_stretch(p, q), width, math.dist(p, q), STEEL)
            _sphere(link, p, width, STEEL)
            _sphere(link, q, width, STEEL)
        blade = [capsule for name in self._blade for capsule in self._capsules if capsule["name"] == name]
        if blade:
            middle, _ = _stretch(blade[0]["p0"], blade[0]["p1"])
            _cylinder(links[blade[0]["joint"]], middle, _normal(blade), 2.0 * PADDLE_RADIUS, BLADE_THICKNESS, RED)
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
                _frame(message, FRAME, BALL_FRAME, record.position.tolist(), (0.0, 0.0, 0.0, 1.0))
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
        for joint, fixed, q in zip(self._joints, self._fixed, position, strict=True):
            place, turned = joint["pos"], fixed
            if joint["type"] == "slide":
                place = (np.array(place) + q * np.array(joint["rot"]) @ np.array(joint["axis"])).tolist()
            else:
                s = math.sin(0.5 * q)
                turned = _product(fixed, (*(s * a for a in joint["axis"]), math.cos(0.5 * q)))
            if parent == FRAME:
                place, turned = self._base.outward(np.array(place)).tolist(), _product(self._turned, turned)
            _frame(message, parent, joint["name"], place, turned)
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


def _frame(message: Any, parent: str, child: str, place: Sequence[float], turned: Sequence[float]) -> None:
    frame = message.transforms.add(parent_frame_id=parent, child_frame_id=child)
    frame.translation.x, frame.translation.y, frame.translation.z = place
    frame.rotation.x, frame.rotation.y, frame.rotation.z, frame.rotation.w = turned


def _table(table: SceneEntity) -> None:
    half_x, half_y = 0.5 * (TABLE_WIDTH - LINE), 0.5 * (TABLE_LENGTH - LINE)
    _cube(table, (0.0, 0.0, -0.5 * TABLE_THICKNESS), (TABLE_WIDTH, TABLE_LENGTH, TABLE_THICKNESS), BLUE)
    for x, width in ((-half_x, LINE), (0.0, 0.003), (half_x, LINE)):
        _cube(table, (x, 0.0, 0.0), (width, TABLE_LENGTH, 0.002), WHITE)
    for y in (-half_y, half_y):
        _cube(table, (0.0, y, 0.0), (TABLE_WIDTH, LINE, 0.002), WHITE)
    _cube(table, (0.0, 0.0, 0.5 * NET_HEIGHT), (TABLE_WIDTH + 2 * NET_OVERHANG, NET_THICKNESS, NET_HEIGHT), GREY)
    for x, y in ((x, y) for x in (-0.6, 0.6) for y in (-1.05, 1.05)):
        _cube(
            table, (x, y, -0.5 * (TABLE_HEIGHT + TABLE_THICKNESS)), (0.05, 0.05, TABLE_HEIGHT - TABLE_THICKNESS), GREY
        )


def _cube(entity: SceneEntity, place: Sequence[float], size: Sequence[float], colour: Sequence[float]) -> None:
    cube = entity.cubes.add()
    _pose(cube, place, (0.0, 0.0, 0.0, 1.0), colour)
    cube.size.x, cube.size.y, cube.size.z = size


def _sphere(entity: SceneEntity, place: Sequence[float], diameter: float, colour: Sequence[float]) -> None:
    sphere = entity.spheres.add()
    _pose(sphere, place, (0.0, 0.0, 0.0, 1.0), colour)
    sphere.size.x = sphere.size.y = sphere.size.z = diameter


def _cylinder(
    entity: SceneEntity,
    place: Sequence[float],
    axis: Sequence[float],
    diameter: float,
    length: float,
    colour: Sequence[float],
) -> None:
    cylinder = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
    _pose(cylinder, place, _towards(axis), colour)
    cylinder.size.x = cylinder.size.y = diameter
    cylinder.size.z = length


def _pose(shape: Any, place: Sequence[float], turned: Sequence[float], colour: Sequence[float]) -> None:
    pose = shape.pose
    pose.position.x, pose.position.y, pose.position.z = place
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = turned
    shape.color.r, shape.color.g, shape.color.b, shape.color.a = colour


def _normal(blade: Sequence[dict[str, Any]]) -> list[float]:
    """Direction across the blade: across its first two capsules, or whatever lies across the only one."""
    (_, first), (_, second) = (_stretch(c["p0"], c["p1"]) for c in (blade[0], blade[-1]))
    normal = np.cross(first, second)
    if not normal.any():
        normal = np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
    normal = normal / np.linalg.norm(normal)
    return (normal * np.sign(normal[np.argmax(np.abs(normal))]) + 0.0).tolist()  # without a negative zero


def _stretch(p: Sequence[float], q: Sequence[float]) -> tuple[list[float], list[float]]:
    """Middle of the stretch from p to q, and its direction."""
    return [0.5 * (a + b) for a, b in zip(p, q, strict=True)], [b - a for a, b in zip(p, q, strict=True)]


def _towards(axis: Sequence[float]) -> tuple[float, ...]:
    """Quaternion x, y, z, w of the shortest turn from the z axis to ``axis``."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    if z < 0.0:  # a cylinder has no direction, and so the opposite turn is never half a one
        x, y, z = -x, -y, -z
    quaternion = np.array([-y, x, 0.0, 1.0 + z])
    return tuple((quaternion / np.linalg.norm(quaternion)).tolist())


def _quaternion(turn: np.ndarray) -> tuple[float, ...]:
    """Quaternion x, y, z, w of a rotation matrix: the longest row of 4 q q^T is the least rounded."""
    trace = np.trace(turn)
    outer = np.empty((4, 4))
    outer[:3, :3] = turn + turn.T + (1.0 - trace) * np.eye(3)
    outer[3, :3] = outer[:3, 3] = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
    outer[3, 3] = 1.0 + trace
    row = outer[np.argmax(np.diag(outer))]
    return tuple((row / np.linalg.norm(row)).tolist())


def _product(a: Sequence[float], b: Sequence[float]) -> tuple[float, ...]:
    """Quaternion product a b: the turn b, then the turn a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )
