"""Frames, shapes and states in the log, and the layout that shows them, by the schemas that Foxglove publishes."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from importlib import resources

import foxglove.layouts as panels
import foxglove.messages as published
import mujoco
import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.json_format import MessageToDict
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation

import mjx_tt
from robot_io import log
from robot_io.calibrated import Frame
from robot_io.contract import JOINT_NAMES, PAPER
from robot_io.limits import LIMITS
from robot_io.log.view import BALL_FRAME, View
from robot_io.safety.clearance import BLADE, RobotGeometry

RANDOM = np.random.default_rng(5)
POSES = RANDOM.uniform(np.array(LIMITS.lower), np.array(LIMITS.upper), (8, 8))
BALL = np.array([0.1, -0.4, 0.3])
LAYOUT = json.loads((resources.files("robot_io.log") / "layout.json").read_text())
CONFIGS = {
    "3D": panels.ThreeDeeConfig,
    "Plot": panels.PlotConfig,
    "RosOut": panels.LogConfig,
    "StateTransitions": panels.StateTransitionsConfig,
}


def published_class(schema: bytes, name: str):
    """Message class of a serialised FileDescriptorSet, in a pool of its own."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


@pytest.fixture(scope="module")
def messages(tmp_path_factory):
    """(schema, log time, message) of each topic of a session; Foxglove's read with its SDK's schemas."""
    with log.FileRecorder(tmp_path_factory.mktemp("view"), "session", {}) as recorder:
        for i, pose in enumerate(POSES):
            recorder.put(log.Joints(0.1 * i, pose, np.zeros(8), 0.1 * i + 0.002))
            recorder.put(log.Joints(0.1 * i + 0.004, pose, np.zeros(8)))  # sooner than a frame is due
        recorder.put(log.Joints(2.0, np.full(8, np.nan), np.zeros(8)))
        recorder.put(log.Ball(2.1, 2.14, BALL, 3), log.Ball(2.104, 2.144, np.full(3, np.nan), 3))
        recorder.put(log.Observation(1, 2.2, np.zeros(11)), log.Action(1, 2.2, np.zeros(8)))
        recorder.put(log.Command(1, 2.2, *np.zeros((3, 8))), log.Tick(1, 2.2, 0.0, 0.0))
        for name, text in (
            ("state", {"from": "disarmed", "to": "ready", "why": "armed by the operator"}),
            ("fault", {"cause": "clearance", "text": "too near"}),
            ("state", {"from": "ready", "to": "disarmed", "why": "fault: too near"}),
            ("state", "no JSON of ours"),
        ):
            recorder.put(log.Event(2.3, log.Level.INFO, name, json.dumps(text)))
    found = {}
    with open(recorder.close(), "rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            definition = schema.data
            if schema.name.startswith("foxglove."):
                definition = getattr(published, schema.name.removeprefix("foxglove.")).get_schema().data
            decoded = published_class(definition, schema.name).FromString(message.data)
            own = published_class(schema.data, schema.name).FromString(message.data)
            assert MessageToDict(decoded) == MessageToDict(own), schema.name
            found.setdefault(channel.topic, []).append((schema.name, message, decoded))
    return found


def test_the_frames_put_the_blade_where_mujoco_has_it(messages):
    model = mujoco.MjModel.from_xml_path(str(resources.files(mjx_tt) / "assets" / "scene.xml"))
    data = mujoco.MjData(model)
    _, _, scene = messages["/scene"][0]
    (disc,) = [c for e in scene.entities if e.id == "joint_6" for c in e.cylinders if c.color.r > 0.7 > 0.2 > c.color.g]
    frames = [message for _, _, message in messages["/tf"] if len(message.transforms) > 1]
    assert len(frames) == len(POSES)
    for i, (pose, message) in enumerate(zip(POSES, frames, strict=True)):
        parent, place, turned = "table", np.zeros(3), Rotation.identity()
        assert [frame.child_frame_id for frame in message.transforms] == list(JOINT_NAMES)
        for frame in message.transforms:
            assert frame.parent_frame_id == parent
            assert frame.timestamp.seconds * 10**9 + frame.timestamp.nanos == round(0.1 * i * 1e9)
            place = place + turned.apply([frame.translation.x, frame.translation.y, frame.translation.z])
            turned = turned * Rotation.from_quat(
                [frame.rotation.x, frame.rotation.y, frame.rotation.z, frame.rotation.w]
            )
            parent = frame.child_frame_id
        for joint, q in zip(JOINT_NAMES, pose, strict=True):
            data.qpos[model.joint(joint).qposadr[0]] = q
        mujoco.mj_kinematics(model, data)
        middle = disc.pose.position
        found = place + turned.apply([middle.x, middle.y, middle.z])
        np.testing.assert_allclose(found, data.geom("col_blade_axis").xpos, atol=1e-6)
        drawn = Rotation.from_quat([getattr(disc.pose.orientation, axis) for axis in "xyzw"])
        normal = np.cross(*(data.geom(f"col_blade_{a}").xmat.reshape(3, 3)[:, 2] for a in ("axis", "cross")))
        assert abs((turned * drawn).apply([0, 0, 1]) @ normal) > 1 - 1e-6


def test_the_ball_has_a_frame_and_every_shape_a_frame_that_exists(messages):
    name, message, last = messages["/tf"][-1]
    assert (name, message.publish_time, message.log_time) == ("foxglove.FrameTransforms", 2_100_000_000, 2_140_000_000)
    (frame,) = last.transforms
    assert (frame.parent_frame_id, frame.child_frame_id) == ("table", BALL_FRAME)
    np.testing.assert_allclose([frame.translation.x, frame.translation.y, frame.translation.z], BALL)
    ((name, _, scene),) = messages["/scene"]
    assert name == "foxglove.SceneUpdate" and all(entity.frame_locked for entity in scene.entities)
    children = {frame.child_frame_id for _, _, message in messages["/tf"] for frame in message.transforms}
    assert {entity.frame_id for entity in scene.entities} == {"table", *children}
    assert all(not entity.lifetime.seconds and not entity.lifetime.nanos for entity in scene.entities)


def test_states_and_faults_make_one_line(messages):
    assert [(name, m.value) for name, _, m in messages["/state"]] == [
        ("foxglove.KeyValuePair", "ready"),
        ("foxglove.KeyValuePair", "fault: clearance"),
    ]


def test_the_layout_names_what_the_log_holds(messages):
    paths = re.findall(r'"value": "([^"]+)"', json.dumps(LAYOUT)) + [
        LAYOUT["configById"]["RosOut!events"]["topicToRender"]
    ]
    assert {"/state.value", "/ball.point.z", "/commands/sent.joints[7].velocity", "/event"} <= set(paths)
    for path in paths:
        topic, *parts = path.split(".")
        value = messages[topic][0][2]
        for part in parts:
            name, _, index = part.rstrip("]").partition("[")
            value = getattr(value, name)[int(index)] if index else getattr(value, name)
    assert set(LAYOUT["configById"]["3D!robot"]["topics"]) <= set(messages)


def test_the_layout_is_one_of_foxgloves():
    def leaves(node):
        if isinstance(node, str):
            return [node]
        assert node["direction"] in ("row", "column") and 0 < node["splitPercentage"] < 100
        return leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(LAYOUT["layout"])) == sorted(LAYOUT["configById"])
    for panel, config in LAYOUT["configById"].items():
        known = CONFIGS[panel.partition("!")[0]]()._to_dict()
        assert set(config) <= set(known), panel


def test_a_calibrated_robot_is_drawn_where_the_gate_has_it():
    base = Frame((0.02, -0.03, 0.01), (0.01, -0.02, 0.03))
    geometry = RobotGeometry.load().moved(base)
    for time, pose in enumerate(POSES):
        (encoded,) = View(base).encode(log.Joints(float(time), pose, np.zeros(8)))
        place, turned = np.zeros(3), Rotation.identity()
        for frame in encoded.message.transforms:
            place = place + turned.apply([getattr(frame.translation, axis) for axis in "xyz"])
            turned = turned * Rotation.from_quat([getattr(frame.rotation, axis) for axis in "xyzw"])
        np.testing.assert_allclose(place + turned.apply(geometry.blade), geometry.middle(BLADE, pose), atol=1e-9)


def test_the_log_of_a_calibrated_robot_draws_it_there(tmp_path):
    places = []
    for name, metadata in (("as_made", {}), ("calibrated", {"robot_base": [[0.02, -0.03, 0.01], [0.0, 0.0, 0.0]]})):
        with log.FileRecorder(tmp_path, name, metadata) as recorder:
            recorder.put(log.Joints(0.0, POSES[0], np.zeros(8)))
        with open(recorder.close(), "rb") as file:
            (_, _, message), *_ = make_reader(file).iter_messages(topics=["/tf"])
        places.append(FrameTransforms.FromString(message.data).transforms[0].translation)
    shift = [getattr(places[1], axis) - getattr(places[0], axis) for axis in "xyz"]
    np.testing.assert_allclose(shift, [0.02, -0.03, 0.01], atol=1e-12)


def test_all_that_stands_still_is_one_shape():
    """Viewers keep one entity of a name."""
    geometry = json.loads((resources.files("robot_io.safety") / "robot_geometry.json").read_text())
    first = geometry["capsules"][0]
    geometry["capsules"] += [first | {"name": name, "joint": "world"} for name in ("post", "foot")]
    entities = View(robot=replace(PAPER, robot="fixed", geometry=json.dumps(geometry))).scene(0.0).message.entities
    (world,) = [entity for entity in entities if entity.id == "world"]
    assert len(world.cylinders) == 2


def test_a_view_never_raises_and_skips_what_is_broken():
    view, nan = View(), np.full(8, np.nan)
    assert not list(view.encode(log.Joints(np.nan, nan, nan)))
    assert list(view.encode(log.Joints(1.0, np.zeros(8), nan)))
    assert list(view.encode(log.Joints(-5.0, np.zeros(8), nan)))  # a clock that begins anew
    for text in ("", "[]", "{}", '{"to": 1, "why": null}', '"x"'):
        assert not list(view.encode(log.Event(0.0, log.Level.ERROR, "fault", text)))
        assert not list(view.encode(log.Event(0.0, log.Level.INFO, "state", text)))
