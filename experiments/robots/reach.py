"""A robot before any training: what it is, how it stands, which balls are in its reach."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import mujoco
import numpy as np

from ballmodel.registry import Balls
from ballmodel.sampling import sample_pool
from experiments.config import build
from experiments.evaluation import reachability
from mjx_tt.env.policy import Policy
from mjx_tt.env.rollout import Simulator
from mjx_tt.env.task import FACING, TaskConfig
from mjx_tt.robot.robots import Robot
from mjx_tt.viz import rendering
from mjx_tt.viz.rendering import Moment
from robot_io.contract import n_parameters

if TYPE_CHECKING:
    from experiments.view.playlist import PolicyPlaylist

SIM_RATE = 150.0  # [Hz]
POOL = 1024
SPEED = 1.5  # [m/s] of the blade below which returning balls gets hard
PADDLE_HEIGHT = (0.0, 0.6)  # [m] over the table where balls are taken


def description(robot: Robot) -> Iterator[str]:
    """Lines about joints, network and home pose, with a warning where the pose is an unusual one."""
    contract, (position, normal, speed) = robot.contract, blade(robot)
    axes = ", ".join(contract.joints[i] for i in contract.carrying) or "no axis"
    yield (
        f"{robot.name}: {len(contract.arm)} joints on {axes}, {contract.n_observation} observations, "
        f"{n_parameters(contract.n_joints)} parameters"
    )
    x, y, z = position
    yield f"blade at home: x {x:.2f}, y {y:.2f}, z {z:.2f} m; faces {(np.round(normal, 2) + 0.0).tolist()}"
    sideways, _, upwards = speed
    yield f"and moves there at up to {sideways:.1f} m/s across and {upwards:.1f} m/s up"
    if normal[1] < FACING:
        yield "warning: the striking face looks away from the human (y below 0.3); turn the home pose or the site"
    if not PADDLE_HEIGHT[0] < z < PADDLE_HEIGHT[1] or not -2.4 < y < -1.2:
        yield "warning: balls come by at y -2.2 to -1.4 m and z 0 to 0.5 m; move mount or home: mjx-tt robot place"
    if min(sideways, upwards) < SPEED:
        yield f"warning: the blade is slow at home (below {SPEED} m/s); another home pose may be faster"


def blade(robot: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position [m], normal and highest speeds [m/s] along x, y and z of the blade at home, (3,) each."""
    model = robot.model()
    data = mujoco.MjData(model)
    data.qpos[:] = robot.home
    mujoco.mj_forward(model, data)
    jacobian, site = np.zeros((3, model.nv)), model.site("paddle").id
    mujoco.mj_jacSite(model, data, jacobian, None, site)
    speed = np.abs(jacobian) @ np.array(robot.contract.limits.policy_velocity)
    return data.site_xpos[site].copy(), data.site_xmat[site].reshape(3, 3)[:, 2].copy(), speed


def draw(robot: Robot, path: Path) -> None:
    """Writes a picture of the robot at home. Raises RuntimeError without OpenGL."""
    rendering.render_png(path, Moment(robot.home), model=robot.model())


def reachable(robot: Robot, balls: Balls, count: int, seed: int = 0) -> reachability.Reachable:
    """A lower bound of the return rate, by motions optimised ball by ball: minutes."""
    simulator = Simulator(TaskConfig(sim_rate=SIM_RATE, robot=robot), len(jax.devices()))
    model = build.nominal_model(robot)
    pool = sample_pool(jax.random.key(seed), balls, model.ball, POOL)
    return reachability.reachable(simulator, pool, model, jax.random.key(seed + 1), count)


def still(robot: Robot) -> Policy:
    """A policy that asks for nothing."""
    contract = robot.contract
    zeros = np.zeros(contract.n_observation, np.float32)
    return Policy(np.zeros(n_parameters(contract.n_joints), np.float32), zeros, zeros)


def standing(robot: Robot, balls: str) -> PolicyPlaylist:
    """Playlist of the viewer: the robot stands at home while balls come."""
    from experiments.view.playlist import PolicyPlaylist  # needs the packages of the viewer
    from experiments.view.recorder import Recorder
    from mjx_tt.sim.model import ModelFile

    recorder = Recorder(TaskConfig(robot=robot), ModelFile(build.nominal_model(robot)))
    return PolicyPlaylist(recorder, [robot.name], [still(robot)], build.distribution(balls, "--balls"), 0)
