"""Diagnosis: logs and a model in; the verdict, the extended model and all that a report draws out.

from mjx_tt import diagnosis
found = diagnosis.diagnose(diagnosis.load_logs(["session1.csv"]))
found.verdict.causes, found.extended
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ballmodel.io.validation import find
from ballmodel.trajectory import Trajectory
from mjx_tt.diagnosis.ball import causes, cross_validation
from mjx_tt.diagnosis.ball import effects as ball_effects
from mjx_tt.diagnosis.ball.cross_validation import Prediction
from mjx_tt.diagnosis.ball.diagnose import BallFindings, diagnose_balls
from mjx_tt.diagnosis.hits import diagnose as paddle
from mjx_tt.diagnosis.hits.diagnose import HitFindings, diagnose_hits
from mjx_tt.diagnosis.hits.paddle_path import joint_path
from mjx_tt.diagnosis.joint import JointFindings, diagnose_joints
from mjx_tt.diagnosis.joint import diagnose as joint
from mjx_tt.diagnosis.joint import effects as joint_effects
from mjx_tt.diagnosis.joint.forward_model import nominal_response
from mjx_tt.diagnosis.logs import Logs
from mjx_tt.diagnosis.tracks import Record, clean
from mjx_tt.diagnosis.verdict import Part, Verdict, combined
from mjx_tt.sim import model as models
from mjx_tt.sim.model import ModelFile, SimModel

SPINS = ("auto", "none", "free")
# Unseen balls must be predicted better with spins, by so many standard errors or to this part of the error without.
SPINS_SURE, SPINS_PAY = 2.5, 0.8
SPINS_LEAD = 0.5  # of the root mean square without, below which spins are a cause though something stays unexplained


@dataclass(frozen=True)
class Diagnosis:
    """Verdict, extended model, and the findings of each plant, None where the logs do not hold it."""

    verdict: Verdict
    extended: ModelFile
    balls: BallFindings | None
    prediction: Prediction | None  # held-out errors ball by ball
    hits: HitFindings | None  # the robot's hits, where balls and all joints were logged by one clock
    robot: JointFindings | None
    record: Record | None = None  # what was done to the tracks to get strokes


def diagnose(
    logs: Logs,
    model: SimModel | None = None,
    spin: str = "auto",
    without: Sequence[str] = (),
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
    provenance: dict | None = None,
    randomise: bool = False,
    home: Mapping[str, float] | None = None,
) -> Diagnosis:
    """Finds what ``model`` gets wrong about the logs.

    spin: "none" where the nominal ball does not spin, so that spin is a cause; "free" where every ball has a spin of
    its own; "auto" for "free" where the model has a Magnus force and "none" where it has none. without: effects of the
    catalogue to omit. randomise: training under the extended model draws what the logs leave open.
    home: true positions [rad], [m] in which joints rest before their first motion; joints that are not logged are not
    looked at.
    Raises ValueError for unknown names, too few balls, or logs without anything to diagnose.
    """
    model = SimModel() if model is None else model
    _check(logs, spin, without)
    say = progress or (lambda text: None)
    of_ball = [name for name in without if name in ball_effects.DESCRIPTIONS]
    of_joints = [name for name in without if name not in of_ball]
    parts: list[Part] = []
    found = prediction = hits = robot = None
    notes = list(logs.notes)
    record = None
    if logs.balls:
        if spin == "auto":
            spin = "free" if model.ball.flight.magnus_coefficient else "none"
        say("parting tracks into strokes")
        # A ball off a racket spins: where spin is not modelled what follows a hit inside a track is not used.
        strokes, record = clean(logs.balls, spin == "free")
        found, prediction, told = _of_balls(strokes, model, spin, of_ball, seed, say)
        say("judging the robot's hits")
        hits = diagnose_hits(found, record.tracks, joint_path(logs.joints, model), without)
        notes += [*record.lines(), *told]
    if logs.joints:
        nominal = {r.joint: nominal_response(model, r.joint, r.robot) for r in logs.joints}
        robot = diagnose_joints(
            logs.joints,
            nominal,
            seed,
            lambda name, done, count: say(f"joint {done} of {count}: {name}"),
            of_joints,
            {joint: at for joint, at in (home or {}).items() if joint in nominal},
        )
    if found is not None and prediction is not None:
        parts += [
            causes.part(found, prediction, without, hits is not None, seed, say),
            paddle.part(found, hits, without),
        ]
    if robot is not None:
        parts += joint.parts(robot)
    verdict, values, ranges = combined(parts, notes)
    provenance = {
        **(provenance or {}),
        "logs": logs.sources,
        "verdict": verdict.verdict,
        "causes": {c.name: {p: [e.estimate, e.low, e.high] for p, e in c.parameters.items()} for c in verdict.causes},
    }
    extended = ModelFile(models.with_values(model, values), ranges if randomise else (), provenance)
    return Diagnosis(verdict, extended, found, prediction, hits, robot, record)


def _check(logs: Logs, spin: str, without: Sequence[str]) -> None:
    if spin not in SPINS:
        raise ValueError(f"spin is {spin!r}, allowed are {', '.join(SPINS)}")
    for name in without:
        if name not in ball_effects.DESCRIPTIONS and name.split(".")[-1] not in joint_effects.NAMES:
            known = {*ball_effects.DESCRIPTIONS, *joint_effects.NAMES}
            find(dict.fromkeys(known), name, "effect")
    if not logs.balls and not logs.joints:
        raise ValueError("the logs hold neither balls nor joints")


def _of_balls(
    balls: Sequence[Trajectory],
    model: SimModel,
    spin: str,
    without: list[str],
    seed: int,
    say: Callable[[str], None],
) -> tuple[BallFindings, Prediction, list[str]]:
    """Findings of the flights, their held-out errors, and notes.

    Where the nominal ball does not spin, with spins if unseen balls are predicted better so.
    """
    mode = "none" if spin == "free" and "magnus" in without else spin
    found = diagnose_balls(balls, model, mode, without, seed, say)
    say("predicting balls that were not used")
    found, prediction = cross_validation.with_companions(found, seed)
    if not found.may_spin:
        return found, prediction, []
    spun = diagnose_balls(balls, model, "cause", without, seed, say)
    spun, of_spun = cross_validation.with_companions(spun, seed)
    plain, with_spins = (1e3 * float(np.nanmedian(p.after)) for p in (prediction, of_spun))
    note = f"unseen balls are predicted to {with_spins:.1f} mm in the median with spin, to {plain:.1f} mm without"
    # Spins of their own let balls take up much that is none: they must pay, and leave nothing open.
    gain = np.log(prediction.after / of_spun.after)
    gain = gain[np.isfinite(gain)]
    pays = gain.mean() > SPINS_SURE * gain.std() / np.sqrt(max(gain.size, 1)) or with_spins < SPINS_PAY * plain
    # A median hides the balls that met what is no spin.
    squares = [np.nanmean(p.after**2) for p in (of_spun, prediction)]
    chosen = pays and (not spun.unexplained or squares[0] < SPINS_LEAD**2 * squares[1])
    return (spun, of_spun, [note]) if chosen else (found, prediction, [note])
