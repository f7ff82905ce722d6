"""The simulation as a round's measurements have it: the world that the next training believes in.

Balls across the table and a minute of joint motion go through the diagnosis. Its extended model, with all that the logs
leave open of it as samples, becomes the simulation; what no such log shows (the rubber, delays of the ball, encoder
zeros, a joint that stays unexplained) is drawn from a stated prior. Nothing here knows the reality.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ballmodel.io import read
from ballmodel.io.atomic_files import replacing
from ballmodel.trajectory import Dataset, Trajectory
from experiments import measurements
from mjx_tt import diagnosis
from mjx_tt.diagnosis import Diagnosis
from mjx_tt.diagnosis.ball.effects import EFFECTS
from mjx_tt.diagnosis.ball.flights.spin_prior import MAGNUS_PRIOR
from mjx_tt.diagnosis.hits.paddle_path import JointPath, joint_path
from mjx_tt.diagnosis.hits.posterior import HitPosterior, settle
from mjx_tt.diagnosis.joint import JointRecord, read_robot_csv
from mjx_tt.diagnosis.logs import ROBOT_FILES
from mjx_tt.sim import model as models
from mjx_tt.sim.model import ModelFile, SimModel
from mjx_tt.sim.randomisation import Randomised, Samples
from robot_io.contract import JOINT_NAMES

BALLS, CLOCK = "balls.csv", 1e6  # [s] by which the clocks of several folders of hits are set apart
BALL_DELAY = "latency.ball_observation"
LIFT = "ball.flight.magnus_coefficient"
# The frame is the table's: bounces that lie too high are a camera that sees high, not a table that stands there.
HEIGHT, SEEN_HIGH = "ball.table.height", "sensing.ball_offset_z"
OF_ALL_JOINTS = ("latency.abb_", "latency.festo_")  # delays that a sound log of every joint settles


def prior(data: Mapping[str, Any], where: str) -> tuple[Randomised, ...]:
    """Ranges of the prior by dotted path. Raises ValueError naming ``where`` and the path at fault."""
    return models.from_dict({"randomise": dict(data)}, where).randomise


def identify(
    logs: Sequence[Path], most: int, believed: ModelFile, before: Sequence[Randomised], hits: Sequence[Path] = ()
) -> tuple[ModelFile, Diagnosis]:
    """The world to train in after these logs, and the diagnosis behind it.

    most: balls that are looked at; believed: the model so far; before: ranges of what may be wrong of it, used where
    the logs say nothing; hits: folders that ``write_hits`` made. Raises ValueError naming the log at fault.
    """
    read = diagnosis.load_logs([str(path) for path in logs])
    if len(read.balls) > most:
        chosen = np.sort(np.random.default_rng(0).permutation(len(read.balls))[:most])
        read = replace(read, balls=tuple(read.balls[i] for i in chosen))
    # People's balls spin, and the table spins those that do not: a lift is believed, and every ball has its own spin.
    model = believed.model
    if model.ball.flight.magnus_coefficient == 0.0:
        model = models.with_values(model, {LIFT: MAGNUS_PRIOR[0]})
    found = diagnosis.diagnose(read, model, spin="free", randomise=True)
    extended, settled = _in_the_tables_frame(found.extended), _settled(found)
    settled |= {SEEN_HIGH} if HEIGHT in settled else set()
    left = tuple(one for one in before if not set(one.paths) <= settled)
    drawn = [one for one in extended.randomise if isinstance(one, Samples)]
    ranges = {path: (ends[0], ends[1]) for one in left for path, ends in one.ends().items()}
    shown = _of_hits(found, hits, extended.model, ranges)
    if shown is not None:
        left = tuple(one for one in left if not set(one.paths) & set(shown.paths))
        settled |= set(shown.paths)
        values = dict(zip(shown.paths, shown.mean.tolist(), strict=True))
        joined = _joined([*drawn, shown.samples(ranges)])
        others = tuple(one for one in extended.randomise if one not in drawn and not set(one.paths) & set(shown.paths))
        extended = replace(extended, model=models.with_values(extended.model, values), randomise=(joined, *others))
    own = {path for one in left for path in one.paths}
    kept = tuple(one for one in believed.randomise if not set(one.paths) & (settled | own))
    return replace(extended, randomise=(*extended.randomise, *left, *kept)), found


def _of_hits(
    found: Diagnosis, folders: Sequence[Path], world: SimModel, ranges: Mapping[str, tuple[float, float]]
) -> HitPosterior | None:
    """What hits say of what is still drawn from its range; None without hits, or where the flights are unexplained."""
    if not folders or found.balls is None or not ranges:
        return None
    balls: list[Trajectory] = []
    paths: list[JointPath] = []
    for i, folder in enumerate(folders):
        later = CLOCK * i
        data, joints = read(folder / BALLS), read_robot_csv(*(folder / name for name in ROBOT_FILES))
        if not isinstance(data, Dataset):
            raise ValueError(f"{folder / BALLS}: holds no trajectories")
        balls += [replace(t, time=t.time + later) for t in data.trajectories]
        path = joint_path(joints, world)
        if path is None:
            raise ValueError(f"{folder}: not all joints are in it; hits need all eight")
        paths.append(JointPath(tuple(t + later for t in path.time), path.position))
    times, places = (
        tuple(map(np.concatenate, zip(*(getattr(path, name) for path in paths), strict=True)))
        for name in ("time", "position")
    )
    prior = {path: (0.5 * (low + high), (high - low) / 12**0.5) for path, (low, high) in ranges.items()}
    if BALL_DELAY in prior:
        # The joints' delay shows in sums with their commands' alone, where it is taken as believed: by how much it is
        # not, the ball's seems to differ.
        mean, deviation = prior[BALL_DELAY]
        prior[BALL_DELAY] = mean, 2**0.5 * deviation
    return settle(found.balls, balls, JointPath(times, places), prior)


def _joined(parts: Sequence[Samples]) -> Samples:
    """Independent samples side by side: rows of each in a random order, as many as the longest has."""
    rng, rows = np.random.default_rng(0), max(len(one.weight) for one in parts)
    picked = [one.values[rng.choice(len(one.weight), rows, p=one.weight / one.weight.sum())] for one in parts]
    return Samples(tuple(p for one in parts for p in one.paths), np.concatenate(picked, axis=1), np.ones(rows))


def _in_the_tables_frame(world: ModelFile) -> ModelFile:
    """The same with the camera's offset in place of the table's height, which no ball before a hit can tell apart."""
    values = models.paths(world.model)
    moved = {HEIGHT: 0.0, SEEN_HIGH: values[SEEN_HIGH] + values[HEIGHT]}
    randomise = tuple(_renamed(one) if isinstance(one, Samples) else one for one in world.randomise)
    return replace(world, model=models.with_values(world.model, moved), randomise=randomise)


def _renamed(drawn: Samples) -> Samples:
    return replace(drawn, paths=tuple(SEEN_HIGH if path == HEIGHT else path for path in drawn.paths))


def _settled(found: Diagnosis) -> set[str]:
    """Parameters that the logs have settled, whether they moved or not."""
    settled = {path for one in found.extended.randomise for path in one.paths}
    gained = found.verdict.held_out is not None and found.verdict.held_out.low > 0.0
    if found.verdict.verdict == "undetermined" and not gained:  # nothing of it was adopted
        return settled
    if found.balls is not None and not found.balls.findings:
        seen = {e.name: e.path for e, s in zip(found.balls.trial.effects, found.balls.seen, strict=True) if s}
        settled |= {e.path for e in EFFECTS if e.name in seen}
    if found.robot is not None:
        open_ = {finding.joint for finding in found.robot.unexplained_by_joint}
        sound = [joint for joint in found.robot.responses if joint not in open_]
        settled |= {f"drives.{joint}.{effect}" for joint in sound for effect in ("lag", "velocity_gain")}
        if set(sound) == set(JOINT_NAMES):
            settled |= {path for path in models.paths() if path.startswith(OF_ALL_JOINTS)}
    return settled


def write_hits(folder: Path, balls: Dataset, records: Collection[JointRecord]) -> None:
    """Writes balls with their hits, and the joints by the same clock, into a folder."""
    write_joints(folder, records)
    measurements.write_csv(folder / BALLS, balls)


def write_joints(folder: Path, records: Collection[JointRecord]) -> None:
    """Writes command.csv and state.csv into a folder, as ``mjx-tt diagnose`` reads them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, quantity in zip(ROBOT_FILES, ("velocity", "position"), strict=True):
        text = io.StringIO()
        writer = csv.writer(text)
        writer.writerow(("t", "joint", quantity))
        for record in records:
            command = quantity == "velocity"
            time = record.command_time if command else record.state_time
            values = record.command_velocity if command else record.state_position
            writer.writerows((repr(float(t)), record.joint, repr(float(v))) for t, v in zip(time, values, strict=True))
        with replacing(folder / name) as temporary:
            temporary.write_text(text.getvalue(), encoding="utf-8")
