"""Eight joints that follow velocity commands, in fine steps: the reference for the robot-side cases.

Order of one joint's response: hold and action delay, deadband, Coulomb friction, gain, velocity limit, first-order lag,
acceleration limit, the robot's own servos and masses (MuJoCo C plays the published scene), backlash, observation delay,
offset.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from tests.support.paths import SCENE

JOINTS = ("gantry_x", "gantry_y", "joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6")
PEAK = (1.4, 1.0, 2.5, 2.0, 2.5, 4.0, 5.0, 6.0)  # [m/s], [rad/s] of a stroke
COMMAND_RATE, ARM_RATE, GANTRY_RATE = 75.0, 250.0, 125.0  # [Hz]
ENCODER = 1e-4  # [m], [rad] deviation of a measured position
STEP = 2e-4  # [s]


@dataclass(frozen=True)
class Joint:
    """Response of one joint to a velocity command."""

    action_delay: float = 0.071  # [s]
    observation_delay: float = 0.029  # [s]
    lag: float = 0.0  # [s]
    velocity_gain: float = 1.0
    joint_offset: float = 0.0
    velocity_limit: float = np.inf
    acceleration_limit: float = np.inf
    backlash: float = 0.0
    coulomb_friction: float = 0.0
    deadband: float = 0.0


def nominal(joint: str) -> Joint:
    return Joint(0.0645, 0.033) if joint.startswith("gantry") else Joint()


def commands(rng: np.random.Generator, seconds: float, level: float = 1.0, gentle: bool = False):
    """Times (n,) and velocities (8, n) of a robot that plays: strokes and their returns, held between, some noise.

    level: factor on every speed. gentle: slow, smooth motion to one side only, which shows little of a joint.
    """
    time = np.arange(int(seconds * COMMAND_RATE)) / COMMAND_RATE
    velocity = np.zeros((8, time.size))
    for j, peak in enumerate(PEAK):
        if gentle:
            # A travel that every joint has room for.
            velocity[j] = 0.4 * peak / seconds * (1.0 - np.cos(2 * np.pi * time / 15.0))
            continue
        start, position = rng.uniform(0.0, 0.5), 0.0
        while start < seconds:
            out, back = rng.uniform(0.18, 0.45), rng.uniform(0.4, 0.8)
            speed = peak * rng.uniform(0.3, 1.0) * rng.choice([-1.0, 1.0])
            # The return brings it home: the area of a half sine is 2/pi of its peak times its length.
            distance = position + speed * out * 2 / np.pi
            homing = -distance * np.pi / (2 * back)
            wait = rng.uniform(0.0, 0.25)
            for begin, length, v in ((start, out, speed), (start + out + wait, back, homing)):
                inside = (time >= begin) & (time < begin + length)
                velocity[j, inside] += v * np.sin(np.pi * (time[inside] - begin) / length)
            position = 0.0
            start += out + wait + back + rng.uniform(0.1, 0.9)
        # A policy's output is not smooth while it acts.
        velocity[j] += (np.abs(velocity[j]) > 0) * rng.normal(0.0, 0.03 * peak, time.size)
    return time, level * velocity


def respond(joint: Joint, time: np.ndarray, velocity: np.ndarray, query: np.ndarray) -> np.ndarray:
    """Measured positions, without noise, at times ``query``, from rest at 0, of a joint whose servo is ideal."""
    grid = np.arange(0.0, max(time[-1], query[-1]) + STEP, STEP)
    return read(joint, grid, drive(joint, time, velocity, grid), query)


def drive(joint: Joint, time: np.ndarray, velocity: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Integral of the velocity that the drive asks of the servo, on a grid of STEP."""
    # The command in the middle of each step: that at its start would be half a step late, which a diagnosis sees.
    index = np.searchsorted(time, grid + STEP / 2 - joint.action_delay, side="right") - 1
    u = np.where(index >= 0, velocity[np.maximum(index, 0)], 0.0)
    u = np.where(np.abs(u) < joint.deadband, 0.0, u)
    u = np.sign(u) * np.maximum(np.abs(u) - joint.coulomb_friction, 0.0)
    u = np.clip(joint.velocity_gain * u, -joint.velocity_limit, joint.velocity_limit)
    if joint.lag > 0.0 or np.isfinite(joint.acceleration_limit):
        after = _follow(u, joint.lag, joint.acceleration_limit)
        u = (np.concatenate([[0.0], after[:-1]]) + after) / 2
    return np.concatenate([[0.0], np.cumsum(u[:-1]) * STEP])


def read(joint: Joint, grid: np.ndarray, q: np.ndarray, query: np.ndarray) -> np.ndarray:
    """Measured positions of a joint that is driven along q."""
    if joint.backlash > 0.0:
        q = _play(q, joint.backlash)
    return np.interp(query - joint.observation_delay, grid, q) + joint.joint_offset


def play(driven: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times and positions (8, n), home at first, of MuJoCo's robot whose servos are asked for these ways."""
    model = mujoco.MjModel.from_xml_path(str(SCENE))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    step = model.opt.timestep
    time = np.arange(0.0, grid[-1], step)
    asked = np.diff(np.stack([np.interp(time, grid, q) for q in driven]), axis=1) / step
    moved = np.repeat(data.qpos[:8, None], time.size, axis=1)
    for k, velocity in enumerate(asked.T, start=1):
        data.ctrl[:8] = velocity
        mujoco.mj_step(model, data)
        moved[:, k] = data.qpos[:8]
    return time, moved


def _follow(u, lag, limit):
    share = 1.0 - np.exp(-STEP / lag) if lag > 0.0 else 1.0
    most, v, out = limit * STEP, 0.0, []
    for wanted in u.tolist():
        v += min(max(share * (wanted - v), -most), most)
        out.append(v)
    return np.array(out)


def _play(q, width):
    here, half, out = float(q[0]), width / 2, []
    for driven in q.tolist():
        here = min(max(here, driven - half), driven + half)
        out.append(here)
    return np.array(out)


def logs(joints: dict[str, Joint], rng: np.random.Generator, seconds=60.0, level=1.0, gentle=False, rest=0.0):
    """Rows of command.csv (t, joint, velocity) and state.csv (t, joint, position); ``rest`` seconds of it at home."""
    time, velocity = commands(rng, seconds, level, gentle)
    velocity[:, time < rest] = 0.0
    command = [(t, name, v) for j, name in enumerate(JOINTS) for t, v in zip(time, velocity[j], strict=True)]
    state = []
    grid = np.arange(0.0, seconds + STEP, STEP)
    moment, moved = play(
        np.stack([drive(joints[name], time, velocity[j], grid) for j, name in enumerate(JOINTS)]), grid
    )
    for j, name in enumerate(JOINTS):
        rate = GANTRY_RATE if name.startswith("gantry") else ARM_RATE
        query = np.arange(int(seconds * rate)) / rate + rng.uniform(0.0, 1.0 / rate)
        position = read(joints[name], moment, moved[j], query) + rng.normal(0.0, ENCODER, query.size)
        state += [(t, name, q) for t, q in zip(query, position, strict=True)]
    return sorted(command), sorted(state)
