"""A robot of one's own in the log of its session, which is then drawn where its folder is gone."""

from __future__ import annotations

import io
import shutil
import struct
import zipfile
from pathlib import Path

import mujoco
import numpy as np
import pytest

from experiments.deploy import robot_attachment
from experiments.errors import ConfigError
from experiments.view import scene
from mjx_tt.robot import robots

CORNERS = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
FACES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))


def tetrahedron(path):
    """Writes a binary STL."""
    triangles = [struct.pack("<12fH", 0, 0, 0, *CORNERS[list(face)].ravel(), 0) for face in FACES]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"\0" * 80 + struct.pack("<I", len(triangles)) + b"".join(triangles))


@pytest.fixture
def folder(tmp_path):
    """A robot named mine, with a mesh in a folder of its own, another outside, and an include."""
    folder = Path(shutil.copytree(robots.SHIPPED / "ur10e_rail", tmp_path / "elsewhere" / "mine"))
    tetrahedron(folder / "looks" / "hood.stl")
    tetrahedron(tmp_path / "elsewhere" / "shared" / "hood.stl")
    (folder / "meshes.xml").write_text(
        '<mujoco><asset><mesh name="hood" file="hood.stl"/><mesh name="cap" file="../../shared/hood.stl"/></asset>'
        "</mujoco>"
    )
    text = (folder / "robot.xml").read_text()
    body = '<body name="carriage" childclass="ur10e" gravcomp="1">'
    geoms = "".join(f'<geom type="mesh" mesh="{name}" contype="0" conaffinity="0"/>' for name in ("hood", "cap"))
    assert body in text and "<compiler " in text
    text = text.replace("<compiler ", '<include file="meshes.xml"/><compiler meshdir="looks" ')
    text = text.replace(body, body + geoms)
    (folder / "robot.xml").write_text(text)
    description = (folder / robots.YAML).read_text()
    assert "name: ur10e_rail" in description
    (folder / robots.YAML).write_text(description.replace("name: ur10e_rail", "name: mine"))
    return folder


def drawn(robot):
    """The scene of the viewer, and its corners of meshes."""
    model = scene.build_tables(1, robot)
    return model, [model.mesh(name).vertnum[0] for name in ("hood", "cap")]


def test_a_robot_with_meshes_and_includes_is_made_anew_from_the_attachment(folder):
    before = robots.load(folder)
    contract, model = before.contract, before.model()
    data = robot_attachment.pack(robots.content(folder), "mine")
    shutil.rmtree(folder.parent)
    robot = robot_attachment.unpack(data, "a.mcap")
    assert robot.contract == contract and robot.path is not None
    assert drawn(robot)[1] == [4, 4]
    again = robot.model()
    for qpos in (robot.home, robot.home + 0.3):
        places = []
        for one in (model, again):
            state = mujoco.MjData(one)
            state.qpos[: len(qpos)] = qpos
            mujoco.mj_kinematics(one, state)
            places.append(state.geom_xpos)
        np.testing.assert_allclose(*places, atol=1e-9)


def zipped(**files):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return stream.getvalue()


@pytest.mark.parametrize(
    "data, why",
    [
        (b"nothing", "no robot in it: File is not a zip file"),
        (zipped(**{"robot.json": "{}", "../outside": "1"}), "'../outside' is no name of a file in it"),
        (zipped(**{"robot.json": " " * 5000}), "no robot in it: more than"),
    ],
)
def test_an_attachment_that_is_no_robot_is_refused(data, why, monkeypatch, tmp_path):
    monkeypatch.setattr(robot_attachment, "UNPACKED", 4000)
    with pytest.raises(ConfigError, match=why):
        robot_attachment.unpack(data, "a.mcap")
    assert not (tmp_path / "outside").exists()
