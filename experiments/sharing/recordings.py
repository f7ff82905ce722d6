"""Sessions at the robot and measured balls as episodes of equal frames at the control rate, for other programs' data
sets."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.deploy.session_logs import LONGEST_GAP, is_session
from experiments.errors import ConfigError, error_context
from mjx_tt import diagnosis
from robot_io import log
from robot_io.contract import CONTROL_RATE, PAPER, Contract

RETURN = "return the ball to the person's side of the table"
FLIGHT = "flight of a ball over the table"
ROBOT = "IRB 120T on two linear axes"  # the paper's
SHORTEST = 2  # frames
LATE = 1.5  # periods between two frames that are told


@dataclass(frozen=True)
class Feature:
    """Type of a column, and the names and units of its components; a number has neither."""

    dtype: str
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()


@dataclass(frozen=True)
class Episode:
    """One ball.

    columns  (n,) or (n, components) of every feature, a frame each 1/75 s
    source   file and number in it
    outcome  "returned" and the like, "" where nobody says
    """

    columns: dict[str, np.ndarray]
    source: str
    outcome: str = ""


@dataclass(frozen=True)
class Recording:
    """Episodes with the same features; what was left out, and what does not fit, in words."""

    task: str
    robot: str | None
    features: dict[str, Feature]
    episodes: tuple[Episode, ...]
    notes: tuple[str, ...]


_TIME = {"session_time": Feature("float64", units=("s",))}  # since the session's start, as it was measured
_DONE = {"next.done": Feature("bool")}
_BALL = PAPER.observation_names[:3], PAPER.observation_units[:3]
BALLS = {"observation.state": Feature("float32", *_BALL), **_TIME, **_DONE}
REWARD = {"next.reward": Feature("float32")}


def features_of(robot: Contract) -> dict[str, Feature]:
    """The columns of a robot's sessions."""
    speeds = robot.joints, tuple(f"{unit}/s" for unit in robot.units)
    return {
        "observation.state": Feature("float32", robot.observation_names, robot.observation_units),
        "action": Feature("float32", *speeds),  # as the policy requested
        "sent": Feature("float32", *speeds),  # after limiter and safety gate
        **_TIME,
        "next.success": Feature("bool"),
        **_DONE,
    }


def read(paths: Sequence[str]) -> Recording:
    """Sessions, or folders of them, or balls in whatever ``mjx-tt diagnose`` reads.

    Raises ConfigError naming the file that is neither, is damaged, or does not go with the others.
    """
    folders = {path: [str(f) for f in sorted(Path(path).glob("*.mcap")) if is_session(f)] for path in paths}
    paths = [file for path, found in folders.items() for file in found or [path]]
    kinds = {path: is_session(Path(path)) for path in paths}
    if len(set(kinds.values())) > 1:
        others = ", ".join(path for path, session in kinds.items() if not session)
        raise ConfigError(f"{others}: no session of `mjx-tt run`, as the others are; one data set holds one kind")
    found = sessions([Path(p) for p in paths]) if all(kinds.values()) else balls(paths)
    if not found.episodes:
        raise ConfigError(f"{', '.join(map(str, paths))}: hold no episode with frames: {'; '.join(found.notes)}")
    return found


def sessions(paths: Sequence[Path]) -> Recording:
    """Every episode of sessions, from its ball's detection to its outcome: the ticks in which the policy played.

    The reward, the sum of the terms that the log holds, comes with the last frame, where all episodes have one.
    Raises ConfigError where the sessions are of different robots.
    """
    robot: Contract | None = None
    episodes: list[Episode] = []
    rewards: list[float | None] = []
    left, steps, latest = Counter[str](), [np.empty(0)], 0.0
    emulated = set()
    for path in paths:
        with error_context():
            session = log.read(path)
        robot = robot or session.robot
        if session.robot != robot:
            raise ConfigError(
                f"{path}: a session of {session.robot.robot}, {paths[0]} is one of {robot.robot}; one data set holds "
                "one robot, and one version of its YAML"
            )
        emulated.add(session.metadata["session"].get("robot") in ("rig", "lockstep"))
        seen, sent = session.observations, session.commands
        ticks, i, j = np.intersect1d(seen.tick, sent.tick, return_indices=True)
        played = np.isin(ticks, session.actions.tick)
        i, j = i[played], j[played]
        time = seen.time[i]
        following = (*(episode.start for episode in session.episodes[1:]), np.inf)
        for episode, bound in zip(session.episodes, following, strict=False):  # there may be none
            end = bound if episode.end is None else episode.end
            mine = np.flatnonzero((time >= episode.start) & (time <= end) & (time < bound))
            if episode.details.get("discarded"):
                left["discarded by the operator"] += 1
            elif mine.size < SHORTEST:
                left[f"of fewer than {SHORTEST} ticks"] += 1
            else:
                clock = time[mine] - time[mine[0]]
                steps.append(np.diff(clock))
                latest = max(latest, float(np.abs(clock - np.arange(mine.size) / CONTROL_RATE).max()))
                columns = {
                    "observation.state": seen.values[:, i[mine]].T,
                    "action": sent.requested[:, j[mine]].T,
                    "sent": sent.sent[:, j[mine]].T,
                    "session_time": time[mine] - session.start_time,
                    "next.success": _last(mine.size, episode.outcome == "returned"),
                    "next.done": _last(mine.size, True),
                }
                episodes.append(Episode(columns, f"{path.name}, episode {episode.number}", episode.outcome))
                rewards.append(sum(episode.reward.values()) if episode.reward else None)
    notes = [f"left out: {count} episodes {why}" for why, count in left.items()]
    if episodes:
        late = np.concatenate(steps) > LATE / CONTROL_RATE
        notes.append(
            f"{late.sum():,} of {late.size:,} steps took longer than {LATE:g} periods, and frames are up to "
            f"{1e3 * latest:.1f} ms off the even clock: session_time has their true times"
        )
    features, given = features_of(robot or PAPER), [reward for reward in rewards if reward is not None]
    if given and len(given) == len(episodes):
        features = features | REWARD
        for one, reward in zip(episodes, given, strict=True):
            one.columns["next.reward"] = _last(len(one.columns["next.done"]), reward)
    elif given:
        notes.append(f"no rewards: {len(rewards) - len(given)} of {len(rewards)} episodes have none")
    name = ROBOT if robot in (None, PAPER) else robot.robot
    name += ", emulated" if emulated == {True} else ""
    return Recording(RETURN, name, features, tuple(episodes), tuple(notes))


def balls(paths: Sequence[str]) -> Recording:
    """Flights of measured balls, each between two gaps, interpolated linearly at the control rate."""
    with error_context():
        flights = diagnosis.load_logs(paths).balls
    episodes, short = [], 0
    for ball in flights:
        cuts = np.flatnonzero(np.diff(ball.time) > LONGEST_GAP) + 1
        for begin, end in itertools.pairwise((0, *cuts, len(ball))):
            time, position = ball.time[begin:end], ball.position[:, begin:end]
            clock = time[0] + np.arange(int((time[-1] - time[0]) * CONTROL_RATE + 1e-6) + 1) / CONTROL_RATE
            if clock.size < SHORTEST:
                short += 1
                continue
            columns = {
                "observation.state": np.stack([np.interp(clock, time, axis) for axis in position], axis=1),
                "session_time": clock,
                "next.done": _last(clock.size, True),
            }
            episodes.append(Episode(columns, ball.label))
    notes = [f"left out: {short} flights of fewer than {SHORTEST} frames"] if short else []
    return Recording(FLIGHT, None, BALLS, tuple(episodes), tuple(notes))


def _last(length: int, value: bool | float) -> np.ndarray:
    """Zeros but for the last frame."""
    column = np.zeros(length, type(value))
    column[-1] = value
    return column
