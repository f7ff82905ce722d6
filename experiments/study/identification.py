"""The simulation as a round's measurements have it: the world that the next training believes in.

Balls across the table, a minute of joint motion and, after the first play, hits: all parameters are fitted at once,
each with its prior (``mjx_tt.diagnosis.together``). What the logs leave open of them is drawn for every episode as
samples; what no log shows is drawn from a stated prior. Nothing here knows the reality.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ballmodel.io import read
from ballmodel.trajectory import Dataset, Trajectory
from experiments import measurements
from experiments.runs import run_dir
from experiments.study.analysis import delays
from experiments.study.analysis.identified import PRIOR_ALONE
from mjx_tt.diagnosis.hits.paddle_path import JointPath, joint_path
from mjx_tt.diagnosis.joint import JointRecord, read_robot_csv
from mjx_tt.diagnosis.logs import ROBOT_FILES, load_logs
from mjx_tt.diagnosis.together import balls as of_balls
from mjx_tt.diagnosis.together import hits as of_hits
from mjx_tt.diagnosis.together import joints as of_joints
from mjx_tt.diagnosis.together.hits import HEIGHT, SEEN_HIGH
from mjx_tt.sim import model as models
from mjx_tt.sim.model import ModelFile, SimModel
from mjx_tt.sim.randomisation import Randomised, Range, Samples

HitLog = tuple[Sequence[Trajectory], Sequence[JointRecord]]  # balls with hits, the joints by the same clock
BALLS, CLOCK = "balls.csv", 1e6  # [s] by which the clocks of several folders of hits are set apart


def read_prior(data: Mapping[str, Any], where: str) -> tuple[Range, ...]:
    """Ranges of the prior by dotted path. Raises ValueError naming ``where`` and the path at fault."""
    found = models.from_dict({"randomise": dict(data)}, where).randomise
    ranges = tuple(one for one in found if isinstance(one, Range))
    if len(ranges) < len(found):
        raise ValueError(f"{where}: samples; a prior has ranges")
    return ranges


def identify(
    logs: Sequence[Path],
    most: int,
    believed: ModelFile,
    before: Sequence[Range],
    hits: Sequence[Path] = (),
    seconds: float = 60.0,
) -> ModelFile:
    """The world to train in after these logs.

    Its provenance holds the number of flights and of hits (0: the rubber is drawn from the prior), the deviation [rad],
    [m] of each joint that nothing explains, and whether the fit of the balls converged within its rounds.

    most: balls that are looked at; believed: the model so far; before: prior ranges of its errors, used for what the
    logs do not show; without a log of joints this includes the drives; hits: folders that ``write_hits`` made;
    seconds: of the joints' motion that are looked at, in the middle of a longer log. Raises ValueError naming the log
    at fault.
    """
    found = load_logs([str(path) for path in logs])
    balls = found.balls
    if len(balls) > most:
        balls = tuple(balls[i] for i in np.sort(np.random.default_rng(0).permutation(len(balls))[:most]))
    return identify_world(balls, found.joints, [_read_hits(folder) for folder in hits], believed, before, seconds)


def identify_world(
    balls: Sequence[Trajectory],
    joints: Sequence[JointRecord],
    hits: Sequence[HitLog],
    believed: ModelFile,
    before: Sequence[Range],
    seconds: float = 60.0,
) -> ModelFile:
    """``identify`` from what is in the logs already; hits may be those of the balls themselves."""
    ranges = {one.path: (one.low, one.high) for one in before}
    arm, axes, high = (models.paths(believed.model)[path] for path in (delays.ARM, delays.AXES, SEEN_HIGH))
    known = delays.compute_moments(ranges, arm)
    seen = {path: normal for path, normal in known.items() if path != SEEN_HIGH}
    if SEEN_HIGH in known:  # beside what the model has of it already
        mean, deviation = known[SEEN_HIGH]
        seen[HEIGHT] = mean - high, deviation
    balls_fit = of_balls.fit(balls, believed.model, seen)
    joints_fit = of_joints.fit(cut_middle(joints, seconds), believed.model, known) if joints else None
    hits_fit = _fit_hits(balls_fit, hits, believed.model, known)
    parts = [] if joints_fit is None else [joints_fit.samples()]
    lift = np.random.default_rng(1).normal(0.0, of_balls.LIFT_ERROR, of_balls.DRAWS)
    if hits_fit is not None:
        shown, lift = hits_fit.samples(delays.shift_to_arm(ranges, arm))
        parts.append(shown)
    sampled = {path for one in parts for path in one.paths}
    # Against the arm, whose delay is as believed; which other ranges know nothing of.
    unseen = [path for path in (delays.AXES, delays.BALL) if parts and path in ranges and path not in sampled]
    if unseen:
        parts.append(delays.draw_unseen(ranges, arm, unseen, of_balls.DRAWS))
    # In the table frame it is the camera that is off, not the table's height: no ball before a hit can tell them apart.
    of_flight = balls_fit.samples(lift)
    offset = np.where(np.array(of_flight.paths) == HEIGHT, high, 0.0)
    paths = tuple(SEEN_HIGH if path == HEIGHT else path for path in of_flight.paths)
    every = [replace(of_flight, paths=paths, values=of_flight.values + offset), *parts]
    drawn = np.concatenate([one.values for one in every], axis=1)  # row by row side by side
    drawn_paths = tuple(path for one in every for path in one.paths)
    samples = delays.shift_command(Samples(drawn_paths, drawn, np.ones(len(drawn))), axes)
    settled = {*samples.paths, *((delays.ARM,) if parts else ())}
    others: list[Randomised] = [one for one in before if one.path not in settled]
    covered = settled | {one.path for one in before}
    others += [one for one in believed.randomise if not set(one.paths) & covered]
    centre = {HEIGHT: models.paths(believed.model)[HEIGHT]}
    centre |= dict(zip(samples.paths, samples.values.mean(axis=0).tolist(), strict=True))
    made_of = {
        "flights": balls_fit.problem.grid.n,
        "hits": 0 if hits_fit is None else hits_fit.hits,
        "joints": {} if joints_fit is None else joints_fit.left,
        "settled": bool(balls_fit.posterior.converged),
        PRIOR_ALONE: unseen,
    }
    return ModelFile(models.with_values(balls_fit.model(), centre), (samples, *others), {"identified": made_of})


def cut_middle(records: Sequence[JointRecord], seconds: float) -> tuple[JointRecord, ...]:
    """The middle ``seconds`` of records that are longer by more than a second."""
    first = max(r.state_time[0] for r in records)
    last = min(r.state_time[-1] for r in records)
    if last - first <= seconds + 1.0:
        return tuple(records)
    begin = 0.5 * (first + last - seconds)
    return tuple(r.between(begin, begin + seconds) for r in records)


def _fit_hits(
    balls_fit: of_balls.BallsTogether, logs: Sequence[HitLog], world: SimModel, known: of_hits.Prior
) -> of_hits.HitsTogether | None:
    """Posterior after the hits in these logs; None where there are none, or too few."""
    if not logs:
        return None
    balls: list[Trajectory] = []
    paths: list[JointPath] = []
    for i, (played, joints) in enumerate(logs):
        later = CLOCK * i
        balls += [replace(t, time=t.time + later) for t in played]
        path = joint_path(joints, world)
        if path is None:
            raise ValueError("not all joints are in a log; hits need all eight")
        paths.append(JointPath(tuple(t + later for t in path.time), path.position))
    times, places = (
        tuple(map(np.concatenate, zip(*(getattr(path, name) for path in paths), strict=True)))
        for name in ("time", "position")
    )
    return of_hits.fit(balls_fit, balls, JointPath(times, places), known)


def _read_hits(folder: Path) -> HitLog:
    data, joints = read(folder / BALLS), read_robot_csv(folder / ROBOT_FILES[0], folder / ROBOT_FILES[1])
    if not isinstance(data, Dataset):
        raise ValueError(f"{folder / BALLS}: holds no trajectories")
    return data.trajectories, joints


def write_hits(folder: Path, balls: Dataset, records: Collection[JointRecord]) -> None:
    """Writes balls with their hits, and the joints by the same clock, into a folder."""
    write_joints(folder, records)
    measurements.write_csv(folder / BALLS, balls)


def write_joints(folder: Path, records: Collection[JointRecord]) -> None:
    """Writes command.csv and state.csv into a folder, as ``mjx-tt diagnose`` reads them."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = {
        "velocity": [(r.joint, r.command_time, r.command_velocity) for r in records],
        "position": [(r.joint, r.state_time, r.state_position) for r in records],
    }
    for file, (quantity, columns) in zip(ROBOT_FILES, parts.items(), strict=True):
        rows = (
            (repr(float(t)), joint, repr(float(v)))
            for joint, time, values in columns
            for t, v in zip(time, values, strict=True)
        )
        run_dir.write_csv(folder / file, ("t", "joint", quantity), rows)
