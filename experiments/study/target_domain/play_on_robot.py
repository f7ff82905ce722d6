"""Play of a study's policies on a robot: the choice among seeds, and the final evaluation.

The evaluation is a virtual player's rallies on the rig, or people's with policies under code names.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from experiments import sparse_reward
from experiments.deploy import play
from experiments.errors import ConfigError, RunError, error_context
from experiments.finetuning import loop
from experiments.options import LOCK_STEP, RIG, RobotOptions
from experiments.runs import load_policy
from experiments.runs.load_policy import TrainedPolicy
from experiments.runs.run_dir import Run
from experiments.study import blind_protocol
from experiments.study.analysis import scoring
from experiments.study.workflow import Step, Waiting
from experiments.training import finalize
from mjx_tt.rally.end_reasons import End
from robot_io.policy import artefact as artefacts

LOGS = "selection"  # folder of a run
SESSIONS = 3  # on the rig at most in one go, until all rallies are played: a busy machine ends some by its own faults


def derive_seed(name: str) -> int:
    """Seed of a step of that name."""
    return zlib.crc32(name.encode()) >> 1


def export_once(trained: TrainedPolicy, console: Console) -> Path:
    """The artefact of a run, exported if it has none. Raises ConfigError for a policy that the robot cannot run."""
    folder = Run(trained.source).artefact
    if not (folder / "manifest.json").exists():
        experiment = loop.experiment_of(trained.source)
        if not finalize.export_policy(folder, trained, experiment, None, console):
            raise ConfigError(f"{trained.source}: acts at another rate than the robot")
    return folder


def score(trained: TrainedPolicy, robot: str, balls: int, seed: int, console: Console) -> float:
    """The paper's sparse reward by which a seed is chosen, mean over balls on a robot.yaml's robot, RIG or LOCK_STEP.

    seed: of the balls of an emulated one. Raises Waiting where fewer balls were played, RunError where the person
    brought none onto the robot's half.
    """
    if robot == LOCK_STEP:
        emulated = loop.lock_step_robot(loop.experiment_of(trained.source), seed=seed)
        policy = trained.policy.astype(np.float32)
        found = sparse_reward.reward_of(emulated.play(policy, n).summary for n in range(balls))
    else:
        artefact, logs = export_once(trained, console), trained.source / LOGS
        console.print(f"{balls} balls with {trained.source}", highlight=False, soft_wrap=True)
        play.run(artefact, robot, logs, console, RobotOptions(seed=seed), balls)
        report = _read_reports(logs, artefacts.load(artefact).digest)[-1]
        if report["episodes"] < balls:
            raise Waiting(f"{report['episodes']} of {balls} balls were played with {trained.source}; once more")
        found = report["selection_reward"]
    if found is None:
        raise RunError(f"{trained.source}: no ball came onto the robot's half")
    return found


def _read_reports(folder: Path, artefact: str) -> list[dict[str, Any]]:
    """Reports of the sessions in a folder with the policy of that digest, in the order of play."""
    found = []
    for path in sorted(p for p in folder.glob("[0-9]*.json") if "." not in p.stem):
        with error_context(str(path)):
            found.append(json.loads(path.read_text(encoding="utf-8")))
    return [report for report in found if report["artefact_sha256"] == artefact]


def make_rally_step(
    folder: Path,
    who: tuple[int, str, str, str],
    run_of: Callable[[], Path],
    inputs: tuple[Path, ...],
    rallies: int,
    console: Console,
) -> Step:
    """Rallies of a virtual player with a policy on the rig. who: seed, trainer, evaluator, model.

    Rallies count however a session or the program ended, and the next run of the step goes on with them: to drop them
    would choose among a policy's sessions.
    """
    seed, trainer, evaluator, model = who
    name, counted = f"seed{seed}/rallies/{trainer}-{evaluator}-{model}", folder / blind_protocol.EVALUATIONS

    def run() -> str:
        artefact = export_once(load_policy.load(run_of()), console)
        digest, status = artefacts.load(artefact).digest, 1
        for session in range(SESSIONS + 1):
            reports = _read_reports(folder, digest)
            found = [rally for report in reports for rally in (report.get("rallies") or {"list": []})["list"]]
            missing = rallies - sum(not rally["filtered"] for rally in found)
            if missing <= 0:
                break
            if status == 0 or session == SESSIONS:  # somebody ended it by a key, or it fails again and again
                raise RunError(
                    f"{name}: {rallies} rallies that count are needed, {missing} are missing. Make the machine quiet; "
                    "the same command goes on with those that were played"
                )
            console.print(f"{name}: {missing} of {rallies} rallies are left to play", highlight=False, soft_wrap=True)
            options = RobotOptions(seed=derive_seed(name) + len(reports), player=evaluator)
            status = play.run(artefact, RIG, folder, console, options, rallies=missing)
            if status == play.INTERRUPTED:
                raise KeyboardInterrupt(f"{name}: stopped")
        lengths, ends = [rally["length"] for rally in found], [End[rally["end"]] for rally in found]
        scored = scoring.score_rallies(seed, trainer, evaluator, model, "", lengths, ends)
        scoring.write(counted, scored)
        return f"{len(found)} rallies, {scored.length[~scored.filtered].mean():.1f} touches on average"

    return Step(name, inputs, (counted,), run)


def make_blind_steps(
    folder: Path,
    seed: int,
    trainer: str,
    evaluator: str,
    runs_of: dict[str, Callable[[], Path]],
    inputs: tuple[Path, ...],
    robot: str,
    console: Console,
) -> list[Step]:
    """Two steps: policies under code names with a scoring sheet; then, the sheet filled in, its rallies.

    folder: of this evaluation; runs_of: each model's run. What is played is ``mjx-tt run FOLDER/policies/CODE``.
    """
    name = f"seed{seed}/blind/{trainer}-{evaluator}"
    key, sheet, counted = (folder / x for x in (blind_protocol.KEY, blind_protocol.SHEET, blind_protocol.EVALUATIONS))

    def make() -> str:
        if not key.exists():
            policies = {model: export_once(load_policy.load(run()), console) for model, run in runs_of.items()}
            codes = blind_protocol.make(folder, policies, trainer, evaluator, seed)
            return f"{len(codes)} policies as {', '.join(codes)}"
        blind_protocol.count_progress(folder)  # writes the sheet where it was killed in between
        return "policies under code names"

    def count() -> str:
        progress = blind_protocol.count_progress(folder)
        left = [f"{p.code} has {p.counted} of {scoring.KEEP}" for p in progress if not p.complete]
        if left:
            raise Waiting(
                f"{name}: {evaluator} plays rallies with "
                f"`mjx-tt run {folder / blind_protocol.POLICIES}/CODE --robot {robot}` and "
                f"writes each down in {sheet}; rallies that count: {', '.join(left)}. Then the same command continues"
            )
        return f"{len(blind_protocol.open_key(folder)):,} rallies"

    return [
        Step(name, inputs, (key, sheet), make),
        Step(f"{name} counted", (key,), (counted,), count),
    ]
