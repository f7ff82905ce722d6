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

from ballmodel.io.atomic_files import replacing
from mjx_tt import diagnosis
from mjx_tt.diagnosis import Diagnosis
from mjx_tt.diagnosis.ball.effects import EFFECTS
from mjx_tt.diagnosis.ball.flights.spin_prior import MAGNUS_PRIOR
from mjx_tt.diagnosis.joint import JointRecord
from mjx_tt.diagnosis.logs import ROBOT_FILES
from mjx_tt.sim import model as models
from mjx_tt.sim.model import ModelFile
from mjx_tt.sim.randomisation import Randomised, Samples
from robot_io.contract import JOINT_NAMES

LIFT = "ball.flight.magnus_coefficient"
# The frame is the table's: bounces that lie too high are a camera that sees high, not a table that stands there.
HEIGHT, SEEN_HIGH = "ball.table.height", "sensing.ball_offset_z"
OF_ALL_JOINTS = ("latency.abb_", "latency.festo_")  # delays that a sound log of every joint settles


def prior(data: Mapping[str, Any], where: str) -> tuple[Randomised, ...]:
    """Ranges of the prior by dotted path. Raises ValueError naming ``where`` and the path at fault."""
    return models.from_dict({"randomise": dict(data)}, where).randomise


def identify(
    logs: Sequence[Path], most: int, believed: ModelFile, before: Sequence[Randomised]
) -> tuple[ModelFile, Diagnosis]:
    """The world to train in after these logs, and the diagnosis behind it.

    most: balls that are looked at; believed: the model so far; before: ranges of what may be wrong of it, used where
    the logs say nothing. Raises ValueError naming the log at fault.
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
    own = {path for one in left for path in one.paths}
    kept = tuple(one for one in believed.randomise if not set(one.paths) & (settled | own))
    return replace(extended, randomise=(*extended.randomise, *left, *kept)), found


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
