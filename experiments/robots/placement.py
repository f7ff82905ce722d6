"""Mounting and home pose of a robot for a ball distribution.

For each ball a few places are taken where it can be met after its bounce, with the direction in which the blade has to
face to send it to the middle of the human's half. A candidate is a mounting and a home pose. Its score is the share of
balls for which, by inverse kinematics from home, some place can be taken in time, at the joints' speeds and
accelerations and without contact, times how nearly the blade faces at home as most balls want it: a quick stand-in for
the bound on what is in reach (``experiments.evaluation.reachability``), which takes minutes for a single candidate. The
cross-entropy method searches candidates.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ballmodel import flight
from ballmodel.io import yaml
from ballmodel.io.atomic_files import replacing
from ballmodel.registry import Balls
from ballmodel.sampling import sample_pool
from experiments.config import build
from experiments.errors import ConfigError
from experiments.robots.reach import blade
from mjx_tt.env.task import TARGET
from mjx_tt.robot import robots
from mjx_tt.robot.kinematics import PaddleKinematics
from mjx_tt.robot.robots import Robot
from robot_io.safety.clearance import RobotGeometry

STEP = 1.0 / 150.0  # [s] of the balls' flights
LONGEST = 1.6  # [s]
PLACES = 4  # at which a ball may be met
WHERE = (-2.1, -1.35)  # [m] y of such a place
LOWEST = 0.15  # [m] over the table: lower balls take a faster blade
RETURN_SECONDS = 0.45  # [s] that a return flies
GRAVITY = 9.81
REACTION = 0.15  # [s] of latency and of seeing the ball
ITERATIONS = 14  # of the inverse kinematics
DAMPING = 0.05
CLOSE, ASKEW, SOON = 0.03, 0.25, 0.1  # [m], [rad], [s] by which a place may be missed
FACING = 0.4  # [rad] by which the blade at home may face elsewhere than most balls want
GAP = 0.02  # [m] to keep from table, floor and itself
CANDIDATES, ELITES, ROUNDS = 40, 8, 24
STD = (0.15, 0.15, 0.1, 0.25)  # [m], [rad] first deviations of x, y, z, yaw
HOME_STD = 0.25  # of a joint's home, as a share of a quarter of its range
BOX = ((-1.0, 1.0), (-3.0, -1.6), (-0.7, 0.3))  # [m] where the MJCF's origin may be


@dataclass(frozen=True)
class Meetings:
    """Places where balls can be met: time (B, K) [s], position [m] and wanted normal (B, K, 3) of the blade."""

    time: np.ndarray
    position: np.ndarray
    normal: np.ndarray


def search(robot: Robot, balls: Balls, samples: int, seed: int) -> tuple[Robot, float, float]:
    """The robot at the best mounting and home pose found for ``samples`` balls, its score and that from before."""
    places = meetings(robot, balls, samples, seed)
    poses = inverse_kinematics(robot, places)
    limits = robot.contract.limits
    low = np.array(limits.lower) + 2.0 * np.array(limits.margin)
    high = np.array(limits.upper) - 2.0 * np.array(limits.margin)
    start = np.array([*robot.file.position, robot.file.yaw, *robot.home])
    lower = np.array([*(b[0] for b in BOX), -np.pi, *low])
    upper = np.array([*(b[1] for b in BOX), np.pi, *high])
    mean = np.clip(start, lower, upper)
    std = np.array([*STD, *(HOME_STD * 0.25 * (high - low))])
    rng = np.random.default_rng(seed)
    before = best_score = score(robot, poses, places)
    best = start
    for _ in range(ROUNDS):
        drawn = np.clip(mean + std * rng.standard_normal((CANDIDATES, mean.size)), lower, upper)
        drawn[0] = mean
        scores = np.array([score(placed(robot, one), poses, places) for one in drawn])
        order = np.argsort(-scores)[:ELITES]
        mean, std = drawn[order].mean(axis=0), drawn[order].std(axis=0) + 0.01
        if scores[order[0]] > best_score:
            best, best_score = drawn[order[0]], float(scores[order[0]])
    return placed(robot, best), best_score, before


def placed(robot: Robot, candidate: np.ndarray) -> Robot:
    """The robot with mounting and home of a candidate (4 + n,)."""
    x, y, z, yaw, *home = (round(float(v), 4) for v in candidate)
    return robot.mounted((x, y, z), yaw, tuple(home))


def meetings(robot: Robot, balls: Balls, samples: int, seed: int) -> Meetings:
    """Places at which balls of the distribution can be met. Raises ConfigError where none comes by."""
    params = build.nominal_model(robot).ball
    state = sample_pool(jax.random.key(seed), balls, params, samples).state

    def advance(carry: tuple, _: None) -> tuple[tuple, tuple]:
        ball, bounces = carry
        moved, events = flight.step(params, ball, STEP)
        bounces = bounces + events.table.astype(jnp.int32)
        return (moved, bounces), (moved.position, moved.velocity, bounces)

    start = (state, jnp.zeros(samples, jnp.int32))
    path = jax.jit(lambda start: jax.lax.scan(advance, start, None, round(LONGEST / STEP))[1])(start)
    position, velocity, bounces = (np.asarray(a) for a in path)
    free = (bounces == 1) & (position[:, 1] > WHERE[0]) & (position[:, 1] < WHERE[1]) & (position[:, 2] > LOWEST)
    rows = [np.flatnonzero(free[:, ball]) for ball in range(samples)]
    some = [
        (ball, np.quantile(row, np.linspace(0.0, 1.0, PLACES)).astype(int)) for ball, row in enumerate(rows) if row.size
    ]
    if not some:
        raise ConfigError("--balls: no ball comes by behind the table's end; nothing to place the robot for")
    index = np.array([ticks for _, ticks in some])
    ball = np.array([number for number, _ in some])[:, None]
    where, arriving = position[index, :, ball], velocity[index, :, ball]
    target = np.array([*TARGET, 0.0])
    leaving = (target - where) / RETURN_SECONDS + np.array([0.0, 0.0, 0.5 * GRAVITY * RETURN_SECONDS])
    change = leaving - arriving
    return Meetings((index + 1) * STEP, where, change / np.linalg.norm(change, axis=-1, keepdims=True))


Poses = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def inverse_kinematics(robot: Robot, places: Meetings) -> Poses:
    """(home (n,), positions and normals (M, 3) in the base's frame) -> joints (M, n) and what they miss (M,)."""
    unmounted = robot.mounted((0.0, 0.0, 0.0), 0.0, robot.file.home)
    kinematics = PaddleKinematics(unmounted.chain(), unmounted.paddle())
    limits = robot.contract.limits
    low, high = (jnp.asarray(end, jnp.float32) for end in (limits.lower, limits.upper))
    margin = jnp.asarray(limits.margin, jnp.float32)

    def blade_at(q: Array) -> Array:
        pose = kinematics.pose(q, jnp.zeros_like(q))
        return jnp.concatenate([jnp.asarray(pose.position) / CLOSE, jnp.asarray(pose.normal) / ASKEW])

    def solve(home: Array, position: Array, normal: Array) -> tuple[Array, Array]:
        wanted = jnp.concatenate([position / CLOSE, normal / ASKEW])

        def improve(q: Array, _: None) -> tuple[Array, None]:
            missed, jacobian = blade_at(q) - wanted, jax.jacfwd(blade_at)(q)
            normal_matrix = (
                jacobian.T @ jacobian + DAMPING * jnp.trace(jacobian.T @ jacobian) * jnp.eye(q.size) / q.size
            )
            return jnp.clip(q - jnp.linalg.solve(normal_matrix, jacobian.T @ missed), low + margin, high - margin), None

        q, _ = jax.lax.scan(improve, home, None, ITERATIONS)
        return q, jnp.linalg.norm(blade_at(q) - wanted)

    many = jax.jit(jax.vmap(solve, in_axes=(None, 0, 0)))

    def poses(home: np.ndarray, position: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q, missed = many(*(jnp.asarray(a, jnp.float32) for a in (home, position, normal)))
        return np.asarray(q, float), np.asarray(missed, float)

    return poses


def score(robot: Robot, poses: Poses, places: Meetings) -> float:
    """Share of the balls that can be met in time, each counted by how nearly it can, in [0, 1]."""
    file, limits = robot.file, robot.contract.limits
    c, s = np.cos(file.yaw), np.sin(file.yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    local = (places.position.reshape(-1, 3) - np.array(file.position)) @ turn
    q, missed = poses(robot.home, local, places.normal.reshape(-1, 3) @ turn)
    way = np.abs(q - robot.home)
    v, a = np.array(limits.policy_velocity), np.array(limits.acceleration)
    seconds = np.where(way > v * v / a, way / v + v / a, 2.0 * np.sqrt(way / a)).max(axis=1)
    slack = places.time.ravel() - REACTION - seconds
    fits = np.exp(-0.5 * missed**2) / (1.0 + np.exp(-np.clip(slack / SOON, -50.0, 50.0)))
    geometry = RobotGeometry.of(robot.contract)
    if geometry.gaps(robot.home[:, None]).min() < GAP:
        return 0.0
    fits = fits * (geometry.gaps(q.T).min(axis=0) > 0.0)
    # A policy begins to learn with small motions: from a blade that already faces as most balls want it.
    _, normal, _ = blade(robot)
    wanted = places.normal.mean(axis=(0, 1))
    facing = np.exp(-0.5 * np.sum((normal - wanted / np.linalg.norm(wanted)) ** 2) / FACING**2)
    return float(facing * fits.reshape(places.time.shape).max(axis=1).mean())


def write(robot: Robot, source: Path, target: Path) -> None:
    """Writes the YAML at ``source`` with the robot's mounting and home pose to ``target``; comments stay.

    Raises ConfigError where the file is written in a way that cannot be edited so.
    """
    text = source.read_text(encoding="utf-8")
    x, y, z = robot.file.position
    mount = f"mount: {{position: [{x:g}, {y:g}, {z:g}], yaw: {robot.file.yaw:g}}}"
    text, count = re.subn(r"^mount:.*$", mount, text, flags=re.MULTILINE)
    if not count:
        text = text.replace("joints:", f"{mount}\njoints:", 1)
    homes = iter(robot.file.home)
    text = re.sub(r"\bhome: *[^,}\s#]+", lambda _: f"home: {next(homes):g}", text)
    if target.parent != source.parent:
        mjcf = yaml.read(source)["mjcf"]
        text = re.sub(r"^mjcf:.*$", f"mjcf: {(source.parent / mjcf).resolve()}", text, flags=re.MULTILINE)
    target.parent.mkdir(parents=True, exist_ok=True)
    with replacing(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
        written = yaml.read(temporary)
        wanted = [written["joints"][name].get("home") for name in robot.contract.joints]
        if not np.allclose(wanted, robot.home, atol=1e-3) or not np.allclose(written["mount"]["position"], (x, y, z)):
            raise ConfigError(f"{source}: write mount on one line and home: once for each joint, then place it again")
    robots.load(target)


def description(before: Robot, now: Robot) -> Iterator[str]:
    """Lines that say what changed."""
    for name, robot in (("before", before), ("now", now)):
        position, normal, _ = blade(robot)
        yield (
            f"{name}: base at {list(robot.file.position)} m, yaw {robot.file.yaw:.3f} rad; blade at "
            f"{(np.round(position, 2) + 0.0).tolist()} m, facing {(np.round(normal, 2) + 0.0).tolist()}"
        )
