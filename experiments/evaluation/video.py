"""Pictures and videos of a policy at play."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from experiments.config.build import Experiment
from experiments.runs.load_policy import TrainedPolicy
from experiments.view.playlist import PolicyPlaylist
from experiments.view.recorder import Recorder
from experiments.view.replay import Replay
from mjx_tt.robot.robots import Robot
from mjx_tt.viz import rendering
from mjx_tt.viz.rendering import GOOD, POOR, Caption, Moment

PICTURE_SIZE, VIDEO_SIZE = (1280, 720), (640, 360)
# [Hz] without a graphics card a frame takes a quarter of a second to draw; a GIF counts in hundredths of a second.
FRAME_RATE = {".mp4": 30.0, ".gif": 25.0}
NEAR_CONTACT = 0.07  # [s] around the paddle's contact
SLOWER = 8  # times, there
REST = 0.3  # [s] the last frame of a ball stays
TRAIL = 0.35  # [s] of the ball's way in a video
PIECE, DOTS_APART = 1.0 / 75.0, 1.0 / 30.0  # [s] of a picture's trail; of the places that are still to come
RETURNED = "returned"


def record(experiment: Experiment, trained: TrainedPolicy, count: int, seed: int) -> list[Replay]:
    """The first ``count`` balls of a seed, as ``mjx-tt view`` shows them."""
    recorder = Recorder(experiment.task, experiment.model)
    play = PolicyPlaylist(recorder, [""], [trained.policy], experiment.distribution, seed)
    return [play.replays(number)[0] for number in range(count)]


def draw(path: Path, replays: Sequence[Replay], camera: str = rendering.CAMERA, robot: Robot | None = None) -> Path:
    """Writes a picture (.png) of the first ball's moment of contact, or a video (.mp4, .gif) of all.

    A video is in real time but for the contact, and the caption says so. robot: None: the paper's.
    Raises ValueError for a wrong suffix or camera, RuntimeError without OpenGL.
    """
    model = None if robot is None else robot.model()
    allowed = (".png", *rendering.VIDEO_SUFFIXES)
    if path.suffix not in allowed:
        raise ValueError(f"{path}: suffix {path.suffix!r}; allowed: {', '.join(allowed)}")
    if path.suffix == ".png":
        rendering.render_png(path, at_contact(replays[0]), camera, PICTURE_SIZE, model)
    else:
        rate = FRAME_RATE[path.suffix]
        moments = [moment for number, replay in enumerate(replays, 1) for moment in video_moments(replay, number, rate)]
        rendering.render_video(path, moments, rate, camera, VIDEO_SIZE, model)
    return path


def at_contact(replay: Replay) -> Moment:
    """The paddle's contact, or where a missed ball is nearest to the robot's end; all of the ball's way.

    The way up to here is a line, the rest, down to the table's height, is dots.
    """
    ball = replay.balls["ball"]
    at = replay.frame(replay.contact) if np.isfinite(replay.contact) else int(np.nanargmin(ball[:, 1]))
    before, after = ball[: at + 1], ball[at:]
    low = np.flatnonzero(after[:, 2] < 0.0)
    after = after[: low[0] if low.size else len(after)]
    every, apart = _frames(replay, PIECE), _frames(replay, DOTS_APART)
    trail = np.concatenate([before[:-1:every], before[-1:]])
    return Moment(replay.qpos[at], ball[at], trail, after[apart::apart], _caption(replay, 1, decided=True))


def video_moments(replay: Replay, number: int, rate: float) -> Iterator[Moment]:
    """Moments of one ball for a video of ``rate`` frames per second."""
    ball, t = replay.balls["ball"], 0.0
    every = _frames(replay, PIECE)
    while True:
        at, slow = replay.frame(t), abs(t - replay.contact) < NEAR_CONTACT
        behind = ball[max(0, at - _frames(replay, TRAIL)) : at + 1]
        now = _between(ball, replay, t)
        trail = np.concatenate([behind[::every], now[None]])
        caption = _caption(replay, number, t >= replay.decided, f"1/{SLOWER} speed" if slow else "")
        moment = Moment(_between(replay.qpos, replay, t), now, trail, caption=caption)
        yield moment
        if t >= replay.seconds:
            break
        t = min(t + (1.0 / SLOWER if slow else 1.0) / rate, replay.seconds)
    for _ in range(round(REST * rate)):
        yield moment


def _between(values: np.ndarray, replay: Replay, t: float) -> np.ndarray:
    """Values (T, k) of a replay's frames at a time [s] between two of them, (k,)."""
    at = replay.frame(t)
    share = (t - replay.time[at]) / (replay.time[1] - replay.time[0])
    return values[at] + share * (values[min(at + 1, len(values) - 1)] - values[at])


def _frames(replay: Replay, seconds: float) -> int:
    """Number of a replay's frames that last so long, one at least."""
    return max(1, round(seconds / (replay.time[1] - replay.time[0])))


def _caption(replay: Replay, number: int, decided: bool, note: str = "") -> Caption:
    if decided:
        return Caption(f"Ball {number}", replay.outcome, note, GOOD if replay.outcome.startswith(RETURNED) else POOR)
    start, ball = replay.time[1] - replay.time[0], replay.balls["ball"]
    return Caption(f"Ball {number}", f"{np.linalg.norm(ball[1] - ball[0]) / start:.1f} m/s in", note)
