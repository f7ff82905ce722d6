"""Replays of what was measured: sessions at the robot, and the balls of a diagnosis beside the models' flights."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from ballmodel.trajectory import Trajectory
from experiments import options
from experiments.deploy import robot_attachment, session_logs
from experiments.errors import ConfigError
from experiments.view.playlist import FixedPlaylist
from experiments.view.replay import RATE, Replay, Series
from mjx_tt import diagnosis
from mjx_tt.diagnosis.tracks import clean
from mjx_tt.prediction.flight_fit import Belief, first_part, fit_states, fly_on
from mjx_tt.robot import robots
from mjx_tt.robot.mjcf import home_qpos, load_model
from mjx_tt.robot.robots import Robot
from mjx_tt.sim.model import ModelFile, SimModel
from robot_io.log import Episode, Level, SessionLog, read

FITTED = 0.2  # [s] of a measured flight from which its start is fitted; the rest is predicted
BEFORE, AFTER = 0.2, 0.6  # [s] shown around an episode
GAP = 0.1  # [s] without a sample over which no ball is drawn
MOST = 40  # flights of a diagnosis
TOLD = ("state", "operator")  # events besides warnings and faults
VERDICT, EXTENDED = "verdict.json", "extended.yaml"


def load(path: Path, model: str | None) -> FixedPlaylist:
    """A session at the robot (an .mcap) or a diagnosis (a folder). Raises ConfigError."""
    if path.is_dir():
        if model is not None:
            raise ConfigError(f"--model {model}: a diagnosis has its own two models")
        return load_diagnosis(path)
    return load_session(path, options.load_model(model))


# -- sessions ----------------------------------------------------------------------------------------------------------


def load_session(path: Path, model: SimModel) -> FixedPlaylist:
    """The episodes of a session, or all of it where there are none: measured joints and ball, what was commanded, what
    happened, and the ball as the model flies it on from the first moments of each flight.

    Raises LogError for a damaged log, ConfigError for one without joints.
    """
    log = read(path)
    if log.joints.time.size < 2:
        raise ConfigError(f"{path}: holds no joints")
    flights = session_logs.flights(log)
    robot = find_robot(log, path)
    strokes = [t for t in clean(flights)[0] if t.time[-1] - t.time[0] > FITTED] if flights else []
    flown = list(zip(strokes, _flights(strokes, model), strict=True))
    whole = Episode(1, float(log.joints.time[0]), float(log.joints.time[-1]), "", {}, {})
    episodes = log.episodes or (whole,)
    replays = [_episode(log, episode, flights, flown, robot) for episode in episodes]
    captions = [f"{path.name}, episode {e.number} of {len(episodes)}" for e in episodes]
    return FixedPlaylist([[replay] for replay in replays], captions, robot)


def find_robot(log: SessionLog, path: Path) -> Robot:
    """The robot of a session, to be drawn: that in its log, or one that comes with the program. Raises ConfigError."""
    name, kept = log.robot.robot, log.attachments.get(robot_attachment.NAME)
    if kept is not None:
        robot = robot_attachment.unpack(kept, str(path))
        if robot.contract.joints != log.robot.joints:
            joints, wanted = ", ".join(robot.contract.joints), ", ".join(log.robot.joints)
            where = f"{path}: {robot_attachment.NAME}"
            raise ConfigError(f"{where}: a robot with the joints {joints}; allowed: the session's, {wanted}")
        return robot
    if name not in robots.names():
        raise ConfigError(
            f"{path}: a session of {name}, whose MJCF is not in the log; shown are {', '.join(robots.names())} only; "
            "Foxglove and Lichtblick draw it from the log"
        )
    return robots.load_shipped(name)


def _episode(
    log: SessionLog,
    episode: Episode,
    flights: Sequence[Trajectory],
    flown: Sequence[tuple[Trajectory, np.ndarray]],
    robot: Robot,
) -> Replay:
    start = episode.start - BEFORE
    stop = min(float(log.joints.time[-1]), (episode.start + 2.0 if episode.end is None else episode.end) + AFTER)
    clock = np.arange(start, max(stop, start + 2 / RATE), 1.0 / RATE)
    ball = np.full((len(clock), 3), np.nan)
    for flight in flights:
        _draw(ball, clock, flight.time, flight.position.T)
    simulated = np.full((len(clock), 3), np.nan)
    for stroke, way in flown:
        _draw(simulated, clock, stroke.time[0] + np.arange(len(way)) / RATE, way)
    c, seen, acted = log.commands, log.observations, log.actions
    joints = log.robot.joints
    series = {
        "Commands sent [m/s, rad/s]": _series(joints, c.time, c.sent, clock),
        "Requested by the policy [m/s, rad/s]": _series(joints, c.time, c.requested, clock),
        "Input: ball as seen [m]": _series(("x", "y", "z"), seen.time, seen.values[:3], clock),
        "Output: share of the joints' speed": _series(joints, acted.time, acted.values, clock),
    }
    during = [e for e in log.events if start <= e.time <= stop and (e.level > Level.INFO or e.name in TOLD)]
    events = [(e.time - start, _told(e.name, e.text, e.level)) for e in during]
    weights = {name: (float(value), 1.0) for name, value in episode.reward.items()}
    marks = np.concatenate([f.position.T[(f.time >= start) & (f.time <= stop)] for f in flights] or [np.empty((0, 3))])
    return Replay(
        time=clock - start,
        qpos=np.stack([_joint(log, j, clock, home) for j, home in enumerate(robot.home)], axis=1),
        balls={"measured": ball, "simulated": simulated},
        title="measured (yellow), simulated (blue)",
        outcome=episode.outcome,
        decided=(episode.end or stop) - start,
        marks=marks,
        series={heading: curves for heading, curves in series.items() if curves.time.size > 1},
        terms=weights,
        events=tuple(events),
    )


def _draw(path: np.ndarray, clock: np.ndarray, time: np.ndarray, position: np.ndarray) -> None:
    """Puts positions (n, 3) at times (n,) into the path (T, 3) of a clock, where no sample is further than GAP."""
    during = np.flatnonzero((clock >= time[0]) & (clock <= time[-1]))
    near = np.diff(time)[np.clip(np.searchsorted(time, clock[during]) - 1, 0, len(time) - 2)] < GAP
    during = during[near]
    path[during] = np.stack([np.interp(clock[during], time, axis) for axis in position.T], axis=1)


def _joint(log: SessionLog, j: int, clock: np.ndarray, home: float) -> np.ndarray:
    known = np.isfinite(log.joints.position[j])  # arm and axes report by turns
    if not known.any():
        return np.full(len(clock), home)
    return np.interp(clock, log.joints.time[known], log.joints.position[j, known])


def _series(names: tuple[str, ...], time: np.ndarray, values: np.ndarray, clock: np.ndarray) -> Series:
    inside = (time >= clock[0]) & (time <= clock[-1])
    return Series(names, time[inside] - clock[0], values[:, inside].T)


def _told(name: str, text: str, level: Level) -> str:
    """An event in a line: a state by its names, a fault in capitals."""
    try:
        said = json.loads(text)
    except ValueError:
        said = text
    if isinstance(said, dict):
        way = [f"{said['from']} to {said['to']}"] if "from" in said and "to" in said else []
        said = ", ".join([*way, *(str(said[key]) for key in ("why", "outcome", "fault") if said.get(key))])
    return f"{name.upper() if level > Level.INFO else name}: {said}"


# -- diagnoses ---------------------------------------------------------------------------------------------------------


def load_diagnosis(folder: Path) -> FixedPlaylist:
    """Measured flights of a diagnosis with those of its nominal and its extended model, the worst predicted first.

    Raises ConfigError where the logs that it was made from cannot be found or hold no balls.
    """
    extended = ModelFile.load(folder / EXTENDED)
    nominal = _nominal(folder, extended)
    strokes = [t for t in clean(tuple(_logs(folder, extended)))[0] if t.time[-1] - t.time[0] > FITTED + 0.1]
    if not strokes:
        raise ConfigError(f"{folder}: the logs that it was made from hold no balls")
    ways = {name: _flights(strokes, m) for name, m in (("nominal", nominal), ("extended", extended.model))}
    misses = {name: [_miss(t, w) for t, w in zip(strokes, flown, strict=True)] for name, flown in ways.items()}
    order = np.argsort(-np.array(misses["nominal"]))[:MOST]
    home = home_qpos(load_model())
    verdict = json.loads((folder / VERDICT).read_text(encoding="utf-8"))["verdict"]
    entries, captions = [], []
    for place, i in enumerate(order, 1):
        t = strokes[i]
        clock = t.time[0] + np.arange(len(ways["nominal"][i])) / RATE
        measured = np.full((len(clock), 3), np.nan)
        _draw(measured, clock, t.time, t.position.T)
        balls = {"measured": measured, **{name: flown[i] for name, flown in ways.items()}}
        axes = np.stack(list(balls.values()), axis=2)
        replay = Replay(
            time=clock - clock[0],
            qpos=np.repeat(home[None], len(clock), axis=0),
            balls=balls,
            title="measured (yellow), nominal (red), extended (green)",
            decided=float(t.time[-1] - t.time[0]),
            marks=t.position.T,
            series={f"{axis} [m]": Series(tuple(balls), clock - clock[0], axes[:, k]) for k, axis in enumerate("xyz")},
        )
        entries.append([replay])
        text = ", ".join(f"{name} misses by {1e3 * misses[name][i]:.0f} mm" for name in ways)
        captions.append(f"{verdict}: {t.label}, {place} of {len(order)}; {text}")
    return FixedPlaylist(entries, captions)


def _nominal(folder: Path, extended: ModelFile) -> SimModel:
    path = extended.provenance.get("model", "nominal")
    return SimModel() if path == "nominal" else ModelFile.load(_named(folder, "model", path)).model


def _logs(folder: Path, extended: ModelFile) -> Iterator[Trajectory]:
    for name in extended.provenance.get("logs", {}):
        path = _named(folder, "logs", name)
        if session_logs.is_session(path):
            yield from session_logs.flights(read(path))
        elif path.name not in ("command.csv", "state.csv"):
            yield from diagnosis.load_logs([path]).balls


def _named(folder: Path, key: str, name: str) -> Path:
    """A file that the extended model's provenance names. Raises ConfigError where it is not there."""
    if not (path := Path(name)).is_file():
        raise ConfigError(
            f"{folder / EXTENDED}: provenance.{key} {path}: no such file; look from where it was diagnosed"
        )
    return path


def _flights(strokes: Sequence[Trajectory], model: SimModel) -> list[np.ndarray]:
    """Flights (T, 3) [m] from each first sample to the last, fitted to its first FITTED seconds."""
    if not strokes:
        return []
    fitted = fit_states([first_part(t, FITTED) for t in strokes], Belief.of(model))
    lengths = [int((t.time[-1] - t.time[0]) * RATE) + 1 for t in strokes]
    time = np.repeat(np.arange(1, max(lengths) + 1)[:, None] / RATE, len(strokes), axis=1)
    flown, _ = fly_on(fitted, time)
    return [flown.position[:, :length, 0, i].T for i, length in enumerate(lengths)]


def _miss(t: Trajectory, way: np.ndarray) -> float:
    """Distance [m] of the last sample from the flight at its time."""
    at = np.array([np.interp(t.time[-1] - t.time[0], np.arange(len(way)) / RATE, axis) for axis in way.T])
    return float(np.linalg.norm(at - t.position[:, -1]))
