"""A robot in a session's log: its YAML, its MJCF and the files that this reads, so that it is drawn where they are not.

The paper's robot is not kept: every program has it.
"""

from __future__ import annotations

import atexit
import io
import json
import shutil
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path, PurePath
from typing import Any
from xml.etree import ElementTree

from rich.console import Console

from experiments.deploy.rig import RECORDED, content_of
from experiments.errors import ConfigError, error_context
from mjx_tt.robot import robots
from mjx_tt.robot.robots import Robot
from robot_io.contract import PAPER
from robot_io.policy.artefact import Artefact

NAME = "robot.zip"  # of the attachment
CONTENT, MJCF = "robot.json", "robot.xml"  # in it: ``mjx_tt.robot.robots.content``, and where the MJCF belongs
LARGEST, UNPACKED = 32 << 20, 256 << 20  # bytes of the attachment, and of what is in it

Attachments = tuple[tuple[str, bytes], ...]


def of_policy(artefact: Artefact, console: Console) -> Attachments:
    """The attachment with a policy's robot; none, with the reason on the console, where it cannot be kept."""
    if artefact.contract == PAPER:
        return ()
    return _kept(lambda: content_of(artefact), f"{artefact.folder}: {RECORDED}", console)


def of_content(content: dict[str, Any], where: str, console: Console) -> Attachments:
    """As ``of_policy`` with the plain data of a robot, which ``where`` is the origin of."""
    return _kept(lambda: content, where, console)


def _kept(content: Callable[[], dict[str, Any]], where: str, console: Console) -> Attachments:
    try:
        return ((NAME, pack(content(), where)),)
    except ConfigError as error:
        console.print(f"the log will not hold the robot for mjx-tt view: {error}", style="yellow")
        return ()


def pack(content: dict[str, Any], where: str) -> bytes:
    """A robot's plain data and the files that its MJCF reads, as a zip.

    Raises ConfigError for no robot, one that cannot be made anew from that alone, and one too large.
    """
    with error_context():
        robot = robots.from_content(content, where)
    kept = {key: value for key, value in content.items() if key != robots.ELSEWHERE}
    files: dict[str, Path] = {}
    if robot.path is not None:
        kept["mjcf"], files = _gathered(robot, where)
    size = sum(path.stat().st_size for path in files.values())
    if size > UNPACKED:
        raise ConfigError(f"{where}: its MJCF reads {size >> 20} MiB of files; allowed: {UNPACKED >> 20} MiB")
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(CONTENT, json.dumps(kept))
        for name, path in files.items():
            archive.write(path, name)
    data = stream.getvalue()
    if len(data) > LARGEST:
        raise ConfigError(f"{where}: {len(data) >> 20} MiB with its meshes; allowed: {LARGEST >> 20} MiB")
    if files and unpack(data, where).contract.joints != robot.contract.joints:
        raise ConfigError(f"{where}: another robot with its files beside it; allowed: an MJCF that can be moved")
    return data


def _gathered(robot: Robot, where: str) -> tuple[str, dict[str, Path]]:
    """The MJCF with its includes in it and every file beside it, and those files by their names there."""
    spec, names = robot.own_spec(), dict[str, str]()

    def absolute(path: Path) -> str:
        names.setdefault(str(path), f"{len(names)}-{path.name}")
        return str(path)

    robots.rename_files(spec, absolute)
    with robots.quiet():
        with error_context(where):
            spec.compile()
        root = ElementTree.fromstring(spec.to_xml())
    for element in root.iter():
        for key, value in element.attrib.items():
            element.set(key, names.get(value, value))
    return ElementTree.tostring(root, encoding="unicode"), {name: Path(path) for path, name in names.items()}


def unpack(data: bytes, where: str) -> Robot:
    """The robot of ``pack``; its files last as long as the process. Raises ConfigError that begins with ``where``."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            if sum(entry.file_size for entry in entries) > UNPACKED:
                raise ValueError(f"more than {UNPACKED >> 20} MiB")
            if strange := [entry.filename for entry in entries if PurePath(entry.filename).name != entry.filename]:
                raise ValueError(f"{strange[0]!r} is no name of a file in it")
            content = json.loads(archive.read(CONTENT))
            if len(entries) > 1:
                folder = Path(tempfile.mkdtemp(prefix="mjx-tt-"))
                atexit.register(shutil.rmtree, folder, ignore_errors=True)
                archive.extractall(folder)
                (folder / MJCF).write_text(content["mjcf"], encoding="utf-8", newline="")
                content[robots.ELSEWHERE] = str(folder / MJCF)
    except (zipfile.BadZipFile, KeyError, TypeError, ValueError, OSError, RuntimeError) as error:
        raise ConfigError(f"{where}: {NAME}: no robot in it: {error}") from None
    with error_context():
        return robots.from_content(content, f"{where}: {NAME}")
