"""A robot to simulate: its YAML and MJCF, put at the table.

A robot is a folder with a YAML (``robot_io.robot_file``) and the MJCF that it names. The MJCF holds the robot alone;
table, net, ball, physics options and lights are those of ``assets/scene.xml``. The paper's robot is one such folder of
``assets/robots``.
"""

from __future__ import annotations

import atexit
import copy
import functools
import json
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from ballmodel.io import yaml
from mjx_tt.robot import geometry, mjcf_checks
from mjx_tt.robot.chain import Chain, Frame, chain_from_model
from mjx_tt.robot.mjcf import PADDLE_SITE, Capsule, capsules, paddle_frame
from robot_io import robot_file
from robot_io.contract import PAPER, Contract
from robot_io.robot_file import RobotFile

ASSETS = Path(__file__).parents[1] / "assets"
SHIPPED = ASSETS / "robots"
DEFAULT = "irb120_gantry"  # the paper's
YAML = "description.yaml"
ELSEWHERE = "mjcf_file"  # key of a robot's content: where an MJCF lies that needs files beside it, such as meshes


@dataclass(frozen=True)
class Robot:
    """One robot; equal and hashable by its content.

    file  its YAML
    mjcf  text of the MJCF
    path  where that lies if it needs files beside it, such as meshes; None: the text is all
    """

    file: RobotFile
    mjcf: str
    path: str | None = None

    @property
    def name(self) -> str:
        return self.file.name

    @property
    def home(self) -> np.ndarray:
        """Joint positions (n,) at which episodes begin [m], [rad]."""
        return np.array(self.file.home)

    @property
    def contract(self) -> Contract:
        """Contract of policies for this robot, with the geometry that its safety gate watches."""
        return _contract(self)

    def own_spec(self) -> mujoco.MjSpec:
        """The MJCF as its author wrote it. Raises ValueError in MuJoCo's words."""
        return mujoco.MjSpec.from_string(self.mjcf) if self.path is None else mujoco.MjSpec.from_file(self.path)

    def model(self) -> mujoco.MjModel:
        """A model of its own of the robot at the table. Raises ValueError naming what is wrong with the MJCF."""
        return copy.copy(_compiled(self))

    def scene(self) -> Path:
        """An MJCF of the robot at the table for programs that want a file; it lasts as long as the process."""
        return ASSETS / "scene.xml" if self.contract == PAPER else _scene_file(self)

    def chain(self) -> Chain:
        return chain_from_model(self.model())

    def paddle(self) -> Frame:
        """The blade's centre in the frame of the link that carries it; column 2 of ``rot`` is the striking normal."""
        return paddle_frame(self.model())

    def capsules(self) -> list[Capsule]:
        return capsules(self.model())

    def mounted(self, position: tuple[float, float, float], yaw: float, home: tuple[float, ...]) -> Robot:
        """The same robot, mounted elsewhere and with another home pose."""
        return replace(self, file=replace(self.file, position=position, yaw=yaw, home=home))


def load(path: str | Path) -> Robot:
    """The robot of a shipped name, a folder or a YAML, checked as a whole.

    Raises ValueError with a line for every mistake, naming file, key or element, and what to change; OSError where a
    file cannot be read.
    """
    data, file, mjcf = _read(path)
    return from_content(data, str(file), mjcf)


def paper() -> Robot:
    """The paper's robot."""
    return load_shipped(DEFAULT)


@functools.cache
def load_shipped(name: str) -> Robot:
    """A robot that comes with the program. Raises ValueError with those that do."""
    return load(name)


def names() -> tuple[str, ...]:
    """Names of the robots that come with the program."""
    return tuple(sorted(folder.name for folder in SHIPPED.iterdir() if (folder / YAML).is_file()))


def yaml_path(path: str | Path) -> Path:
    """The YAML of a shipped name, a folder or a YAML itself. Raises ValueError that says what is allowed."""
    given = Path(path)
    if str(path) in names():
        return SHIPPED / str(path) / YAML
    if given.is_dir():
        found = sorted(given.glob("*.yaml"))
        if len(found) == 1:
            return found[0]
        if (given / YAML).is_file():
            return given / YAML
        raise ValueError(f"{path}: holds {len(found)} YAML files; allowed: one that describes the robot, or {YAML}")
    if given.suffix not in (".yaml", ".yml") or not given.is_file():
        known = ", ".join(names())
        raise ValueError(f"{path}: no robot; allowed: a folder with a YAML and an MJCF, that YAML, or one of {known}")
    return given


def content(path: str | Path) -> dict[str, Any]:
    """The robot as plain data that stands alone: its YAML with the text of the MJCF in place of the file's name."""
    return _read(path)[0]


def _read(path: str | Path) -> tuple[dict[str, Any], Path, str | None]:
    """The content, the YAML, and the path of the MJCF where that is a file of its own."""
    file = yaml_path(path)
    data = yaml.read(file)
    if not isinstance(data, dict) or not isinstance(data.get("mjcf"), str) or "<" in data["mjcf"]:
        return data, file, None
    mjcf = file.parent / data["mjcf"]
    try:
        text = mjcf.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{file}: mjcf: {data['mjcf']} cannot be read: {error}; allowed: an MJCF's file") from None
    beside = {ELSEWHERE: str(mjcf.resolve())} if mjcf_checks.needs_files(text) else {}
    return data | {"mjcf": text} | beside, file, str(mjcf)


def from_content(data: Any, where: str, mjcf: str | None = None) -> Robot:
    """The robot in plain data as ``content`` gives it. Raises ValueError as ``load``.

    where, mjcf: names of the origins of YAML and MJCF in messages
    """
    path = data.get(ELSEWHERE) if isinstance(data, dict) else None
    if isinstance(data, dict):
        data = {key: value for key, value in data.items() if key != ELSEWHERE}
    parsed = robot_file.parse(data, where)
    if path is not None and (not Path(path).is_file() or Path(path).read_text(encoding="utf-8") != parsed.mjcf):
        raise ValueError(f"{where}: {path} is missing or was changed since; put the MJCF and its files back there")
    robot = Robot(parsed, parsed.mjcf, path)
    origin = mjcf or path or f"{where}: mjcf"
    mistakes = list(mjcf_checks.find_mistakes(robot, origin, where))
    if mistakes:
        raise ValueError("\n".join(mistakes))
    return robot


@contextmanager
def quiet() -> Iterator[None]:
    """Without MuJoCo's warning that a robot attached under its own names could not be saved by name."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        mujoco.set_mju_user_warning(before)


@functools.cache
def _court() -> str:
    """The scene without its robot, whose names, defaults and units belong to it alone."""
    scene = ElementTree.parse(ASSETS / "scene.xml").getroot()
    for name in ("include", "keyframe"):
        for element in scene.findall(name):
            scene.remove(element)
    return ElementTree.tostring(scene, encoding="unicode")


def rename_files(spec: mujoco.MjSpec, name: Callable[[Path], str]) -> None:
    """Give every mesh, height field, skin and texture that a spec reads from a file the name of its path."""
    base, stripped = Path(spec.modelfiledir), spec.strippath
    meshes, textures = base / spec.meshdir, base / spec.texturedir

    def renamed(folder: Path, file: str) -> str:
        return name(folder / (Path(file).name if stripped else file)) if file else file

    for elements, folder in ((spec.meshes, meshes), (spec.hfields, meshes), (spec.skins, meshes)):
        for element in elements:
            element.file = renamed(folder, element.file)
    for texture in spec.textures:
        texture.file = renamed(textures, texture.file)
        texture.cubefiles = [renamed(textures, file) for file in texture.cubefiles]
    spec.meshdir = spec.texturedir = ""
    spec.strippath = False


def _assembled(robot: Robot) -> mujoco.MjSpec:
    """The robot at the table, mounted, with the keyframe "home" and the site "paddle"."""
    scene, own = mujoco.MjSpec.from_string(_court()), robot.own_spec()
    if robot.path is not None:  # which ``scene`` is written far away from
        rename_files(own, str)
    for geom in own.geoms:  # of the simulation nothing collides; what the rig lets collide it says itself
        geom.contype = geom.conaffinity = 0
    for key in list(own.keys):
        own.delete(key)
    paddle = next((site for site in own.sites if site.name == robot.file.paddle), None)
    if paddle is not None:
        paddle.name = PADDLE_SITE
    half = 0.5 * robot.file.yaw
    frame = scene.worldbody.add_frame(pos=list(robot.file.position), quat=[np.cos(half), 0.0, 0.0, np.sin(half)])
    with quiet():
        scene.attach(own, frame=frame, prefix="")
        scene.add_key(name="home", qpos=list(robot.file.home))
    return scene


@functools.lru_cache(maxsize=16)
def _compiled(robot: Robot) -> mujoco.MjModel:
    spec = _assembled(robot)
    with quiet():
        return spec.compile()


@functools.lru_cache(maxsize=16)
def _contract(robot: Robot) -> Contract:
    if robot == paper():
        return PAPER
    return replace(robot.file.contract, geometry=json.dumps(geometry.describe(robot.file, robot.model())))


@functools.lru_cache(maxsize=16)
def _scene_file(robot: Robot) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="mjx-tt-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    spec, path = _assembled(robot), folder / "scene.xml"
    with quiet():
        spec.compile()
        path.write_text(spec.to_xml(), encoding="utf-8")
    return path
