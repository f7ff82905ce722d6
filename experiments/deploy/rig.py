"""The emulated robot: for ``mjx-tt run --robot rig``, and alone as ``mjx-tt rig``."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ballmodel import registry
from experiments.config import build
from experiments.config import robot as robots
from experiments.deploy.operator_console import Keyboard
from experiments.deploy.virtual_player import VirtualPlayer
from experiments.errors import ConfigError, checked
from mjx_tt.robot import robots as simulated
from mjx_tt.robot.robots import Robot
from mjx_tt.sim.model import SimModel
from robot_io.contract import PAPER
from robot_io.control.rally import Box
from robot_io.emulator.opponent import Opponent, Throws
from robot_io.emulator.processes import Ports, Rig
from robot_io.policy import artefact as artefacts

RIG = "rig"
RECORDED = "provenance.config.robot"  # key of an artefact's manifest
THROWS = 4096  # balls that the rig can throw before it begins anew


def rig_for(
    artefact: artefacts.Artefact, balls: str | None, params_path: str | None, seed: int, player: str | None = None
) -> Rig:
    """A rig with a virtual player, or that throws balls of a distribution: the named one, or that of the training.

    The robot that stands there is the one that the policy was trained for.
    """
    robot = robot_of(artefact)
    params = robots.load_rig(params_path, robot)
    thrower: Opponent | Throws
    if player is not None:
        thrower = VirtualPlayer(player, seed)
    else:
        distribution = build.distribution(balls or _trained_on(artefact), "--distribution")
        thrower = robots.throws_of(distribution, SimModel(), THROWS, seed)
    return Rig(str(robot.scene()), thrower, params, None, robot.contract)


def robot_of(artefact: artefacts.Artefact) -> Robot:
    """The robot that a policy is for, from its recorded configuration.

    Raises ConfigError where that names no robot, or another one than the artefact's contract.
    """
    if artefact.contract == PAPER:
        return simulated.paper()
    where = f"{artefact.folder}: {RECORDED}"
    robot = checked("", simulated.from_content, content_of(artefact), where)
    if robot.contract != artefact.contract:
        name = artefact.contract.robot
        raise ConfigError(f"{where}: no more the {name} of the policy's contract; export the policy again")
    return robot


def content_of(artefact: artefacts.Artefact) -> dict[str, Any]:
    """Plain data of the robot that a policy is for, from its recorded configuration. Raises ConfigError."""
    given = ((artefact.manifest.get("provenance") or {}).get("config") or {}).get("robot")
    if isinstance(given, dict):
        return given
    if given in simulated.names():
        return simulated.content(given)
    name = artefact.contract.robot
    raise ConfigError(
        f"{artefact.folder}: {RECORDED}: got {given!r}; allowed: the content of a robot's YAML, that of {name}"
    )


def box_of(artefact: artefacts.Artefact) -> Box | None:
    """Bounds of the balls that the policy was trained for; None where its artefact does not say."""
    config = (artefact.manifest.get("provenance") or {}).get("config") or {}
    if "balls" not in config:
        return None
    d = registry.box_of(build.distribution(config["balls"], str(artefact.folder)))
    low, high = (*d.position_min, *d.velocity_min, *d.landing_min), (*d.position_max, *d.velocity_max, *d.landing_max)
    return Box(tuple(map(float, low)), tuple(map(float, high)))


def _trained_on(artefact: artefacts.Artefact) -> str | dict[str, Any]:
    config = (artefact.manifest.get("provenance") or {}).get("config") or {}
    if "balls" not in config:
        raise ConfigError(
            f"{artefact.folder}: does not say on which balls it was trained; name some with --distribution"
        )
    return config["balls"]


def rig(
    balls: str,
    rig_params: str | None,
    seed: int,
    ports: tuple[int, ...],
    out: Path,
    console: Console,
    robot: str | None = None,
) -> int:
    """The rig alone, for a bridge that runs elsewhere; until the operator quits.

    robot: name or folder of the robot that stands there, None: the paper's. Raises ConfigError.
    """
    standing = simulated.paper() if robot is None else checked("--robot", simulated.load, robot)
    axes = len(standing.contract.carrying)
    if len(ports) < 2 + axes:
        raise ConfigError(f"--ports: got {len(ports)}; allowed: {2 + axes}, of arm, tracker and {axes} linear axes")
    throws = robots.throws_of(build.distribution(balls, "--distribution"), SimModel(), THROWS, seed)
    chosen = Ports(ports[0], ports[1], ports[2 : 2 + axes])
    keys: dict[str, tuple[str, str]] = {
        "o": ("switch_on", "switch the arm on"),
        "b": ("throw", "throw balls, or stop"),
        "e": ("motors_off", "emergency stop"),
        "f": ("fault", "drive fault"),
        "c": ("cable", "pull or plug an axis's cable"),
        "t": ("drop_out", "tracker silent for 1 s"),
        "q": ("quit", "end"),
    }
    for key in ("f", "c") if not axes else ():
        del keys[key]
    params = robots.load_rig(rig_params, standing)
    with Rig(str(standing.scene()), throws, params, chosen, standing.contract) as running, Keyboard() as keyboard:
        out.write_text(robots.to_yaml(replace(running.robot, robot=_named(robot))), encoding="utf-8")
        console.print(f"the rig runs; {out} is its robot.yaml: mjx-tt run ARTEFACT --robot {out}", highlight=False)
        console.print("   ".join(f"\\[{k}] {text}" for k, (_, text) in keys.items()), highlight=False)
        throwing, connected = False, True
        while True:
            time.sleep(0.1)
            running.check()
            request = keys.get(keyboard.pressed() or "", ("",))[0]
            if request == "quit":
                return 0
            if request == "throw":
                throwing = not throwing
                running.throw(throwing)
            elif request == "fault":
                running.drive_fault(0, 0x31)
            elif request == "cable":
                connected = not connected
                running.connect_axis(0, connected)
            elif request == "drop_out":
                running.drop_out(1.0)
            elif request:
                getattr(running, request)()
            if request:
                qpos, _ = running.state()
                console.print(f"{request}; {running.thrown} balls thrown; joints {np.round(qpos, 3)}", highlight=False)


def _named(robot: str | None) -> str | None:
    """The key ``robot`` of a robot.yaml, wherever that is, from what the command line says."""
    return robot if robot is None or robot in simulated.names() else str(Path(robot).resolve())
