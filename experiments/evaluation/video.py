"""Pictures and videos of a policy at play."""

from __future__ import annotations

import math
from pathlib import Path

import jax
import numpy as np

from ballmodel.sampling import BallPool
from experiments.config import build
from experiments.config.build import Experiment
from experiments.runs.load_policy import TrainedPolicy
from mjx_tt.env.policy import Policy
from mjx_tt.env.rollout import Simulator
from mjx_tt.robot.robot import Robot
from mjx_tt.viz import rendering

SIZE = (640, 360)
FRAME_RATE = 40.0  # [Hz] at most: without a graphics card a frame takes a quarter of a second to draw
PAUSE = 0.3  # [s] the last frame of an episode stays


def replay(
    experiment: Experiment, trained: TrainedPolicy, count: int, seed: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The first ``count`` episodes of a seed as they come: joint positions (T, 8) and ball positions (T, 3) [m]."""
    simulator = Simulator(experiment.task)
    balls = build.pool(experiment, build.key(seed, build.EVALUATION_BALLS), count)
    model = experiment.model

    def play(policy: Policy, key: jax.Array, balls: BallPool) -> tuple[jax.Array, jax.Array, jax.Array]:
        drawn = simulator.draw(key, balls, model.model, model.randomise, count, 1)
        return simulator.replay(policy, drawn)

    key = build.key(seed, build.EVALUATION_EPISODES)
    played = jax.jit(play)(trained.policy, key, balls)
    qpos, ball, length = (np.asarray(a) for a in played)
    return [(qpos[: length[i], :, i], ball[: length[i], :, i]) for i in range(count)]


def draw(
    path: Path,
    episodes: list[tuple[np.ndarray, np.ndarray]],
    rate: float,
    camera: str = "side",
    robot: Robot | None = None,
) -> Path:
    """Writes a picture (.png) of the first episode's moment of contact, or a video (.mp4, .gif) of all in real time.

    rate: control rate [Hz]; robot: None: the paper's. Raises ValueError for a wrong suffix or camera, RuntimeError
    without OpenGL.
    """
    model = None if robot is None else robot.model()
    allowed = (".png", *rendering.VIDEO_SUFFIXES)
    if path.suffix not in allowed:
        raise ValueError(f"{path}: suffix {path.suffix!r}; allowed: {', '.join(allowed)}")
    if path.suffix == ".png":
        qpos, ball = episodes[0]
        at = int(np.argmin(ball[:, 1]))  # the ball turns where it meets the paddle
        rendering.render_png(path, qpos[at], ball[at], camera, model=model)
        return path
    stride = math.ceil(rate / FRAME_RATE)
    rate, episodes = rate / stride, [(qpos[::stride], ball[::stride]) for qpos, ball in episodes]
    pause = round(PAUSE * rate)
    parts = [tuple(np.concatenate([a, np.repeat(a[-1:], pause, axis=0)]) for a in episode) for episode in episodes]
    qpos, ball = (np.concatenate(part) for part in zip(*parts, strict=True))
    rendering.render_video(path, qpos, ball, rate, camera, SIZE, model=model)
    return path
