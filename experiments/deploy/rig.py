"""The emulated robot: for ``mjx-tt run --robot rig``, and alone as ``mjx-tt rig``."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ballmodel import registry
from experiments.config import build
from experiments.config import robot as robots
from experiments.deploy.operator_console import QUIT, Keyboard
from experiments.deploy.virtual_player import VirtualPlayer
from experiments.errors import ConfigError, error_context
from experiments.options import RobotOptions
from mjx_tt.robot import robots as simulated
from mjx_tt.robot.robots import Robot
from mjx_tt.sim.model import SimModel
from robot_io.contract import PAPER
from robot_io.control.rally import Box
from robot_io.emulator.opponent import Opponent, Throws
from robot_io.emulator.processes import Ports, Rig
from robot_io.policy import artefact as artefacts

RECORDED = "provenance.config.robot"  # key of an artefact's manifest
THROWS = 4096  # balls that the rig can throw before it begins anew


def rig_for(policy: artefacts.Artefact, setup: RobotOptions) -> Rig:
    """A rig with a virtual player, or that throws balls of a distribution: the named one, or that of the training.

    The robot that stands there is the one that the policy was trained for.
    """
    robot = robot_of(policy)
    params = robots.load_rig(setup.rig, robot)
    opponent: Opponent | Throws
    if setup.player is not None:
        opponent = VirtualPlayer(setup.player, setup.seed)
    else:
        balls = setup.distribution or _recorded(policy).get("balls")
        if balls is None:
            raise ConfigError(
                f"{policy.folder}: does not say on which balls it was trained; name some with --distribution"
            )
        opponent = robots.throws_of(build.distribution(balls, "--distribution"), SimModel(), THROWS, setup.seed)
    return Rig(str(robot.scene()), opponent, params, None, robot.contract)


def robot_of(artefact: artefacts.Artefact) -> Robot:
    """The robot that a policy is for, from its recorded configuration.

    Raises ConfigError where that names no robot, or another one than the artefact's contract.
    """
    if artefact.contract == PAPER:
        return simulated.paper()
    where = f"{artefact.folder}: {RECORDED}"
    with error_context():
        robot = simulated.from_content(content_of(artefact), where)
    if robot.contract != artefact.contract:
        name = artefact.contract.robot
        raise ConfigError(f"{where}: no more the {name} of the policy's contract; export the policy again")
    return robot


def content_of(artefact: artefacts.Artefact) -> dict[str, Any]:
    """Plain data of the robot that a policy is for, from its recorded configuration. Raises ConfigError."""
    given = _recorded(artefact).get("robot")
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
    balls = _recorded(artefact).get("balls")
    if balls is None:
        return None
    d = registry.box_of(build.distribution(balls, str(artefact.folder)))
    low, high = (*d.position_min, *d.velocity_min, *d.landing_min), (*d.position_max, *d.velocity_max, *d.landing_max)
    return Box(tuple(map(float, low)), tuple(map(float, high)))


def _recorded(artefact: artefacts.Artefact) -> dict[str, Any]:
    """The configuration that an artefact records, empty where it does not."""
    return (artefact.manifest.get("provenance") or {}).get("config") or {}


def serve(
    balls: str,
    rig_params: str | None,
    seed: int,
    ports: tuple[int, ...],
    out: Path,
    console: Console,
    robot: str | None = None,
) -> int:
    """Runs the rig alone, for a bridge that runs elsewhere, until the operator quits.

    robot: name or folder of the robot that stands there, None: the paper's. Raises ConfigError.
    """
    with error_context("--robot"):
        standing = simulated.paper() if robot is None else simulated.load(robot)
    axes = len(standing.contract.carrying)
    if len(ports) < 2 + axes:
        raise ConfigError(f"--ports: got {len(ports)}; allowed: {2 + axes}, of arm, tracker and {axes} linear axes")
    throws = robots.throws_of(build.distribution(balls, "--distribution"), SimModel(), THROWS, seed)
    chosen = Ports(ports[0], ports[1], ports[2 : 2 + axes])
    named = robot if robot is None or robot in simulated.names() else str(Path(robot).resolve())
    params = robots.load_rig(rig_params, standing)
    with Rig(str(standing.scene()), throws, params, chosen, standing.contract) as running, Keyboard() as keyboard:
        out.write_text(robots.to_yaml(replace(running.robot, robot=named)), encoding="utf-8")
        console.print(f"the rig runs; {out} is its robot.yaml: mjx-tt run ARTEFACT --robot {out}")
        throwing, plugged = cycle((True, False)), cycle((False, True))
        keys: dict[str, tuple[str, Callable[[], object]]] = {
            "o": ("switch the arm on", running.switch_on),
            "b": ("throw balls, or stop", lambda: running.throw(next(throwing))),
            "e": ("emergency stop", running.motors_off),
            **({"f": ("drive fault", lambda: running.drive_fault(0, 0x31))} if axes else {}),
            **({"c": ("pull or plug an axis's cable", lambda: running.connect_axis(0, next(plugged)))} if axes else {}),
            "t": ("tracker silent for 1 s", lambda: running.drop_out(1.0)),
        }
        console.print("   ".join(f"[{key}] {text}" for key, (text, _) in keys.items()) + "   [q] end")
        while True:
            time.sleep(0.1)
            running.check()
            key = keyboard.pressed()
            if key == QUIT:
                return 0
            if key in keys:
                text, act = keys[key]
                act()
                qpos, _ = running.state()
                console.print(f"{text}; {running.thrown} balls thrown; joints {np.round(qpos, 3)}")
