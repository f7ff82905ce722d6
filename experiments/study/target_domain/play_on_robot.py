"""A study on a robot: the loop waits for its operator, who fine-tunes by ``mjx-tt finetune``, and for its players.

A step that people do is started here with the same code as the command of its own, and goes on where it was left. What
they have not finished ends the program with a sentence that says what to do; the same command then continues the study.
The evaluation is a virtual player's rallies on the rig, or people's with policies under code names.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ballmodel.io import read
from ballmodel.trajectory import Dataset, Trajectory
from experiments import measurements, sparse_reward
from experiments.config import robot as robots
from experiments.config.study import Study
from experiments.deploy import play, session_logs
from experiments.deploy.virtual_player import VirtualPlayer
from experiments.errors import ConfigError, RunError, error_context
from experiments.finetuning import loop
from experiments.finetuning import on_robot as tuning
from experiments.finetuning.robot import SCENE, BallRecorder
from experiments.options import LOCK_STEP, RIG, RobotOptions
from experiments.runs import load_policy
from experiments.runs.load_policy import TrainedPolicy
from experiments.runs.run_dir import Run
from experiments.study import blind_protocol
from experiments.study.analysis import scoring
from experiments.study.target_domain.lab_logs import HitLog
from experiments.study.workflow import Step, Waiting, derive_seed
from experiments.training import finalize
from mjx_tt.diagnosis.logs import ROBOT_FILES, before_racket, load_logs
from mjx_tt.rally.end_reasons import End
from robot_io.emulator.config import RigParams
from robot_io.emulator.lockstep import LockStep
from robot_io.policy import artefact as artefacts

BALLS, AROUND = 120, 1.0  # of a fine-tuning of which everything is kept; [s] of the joints before and after them
LEAST_SAMPLES = 20  # of a ball that is looked at
LONGEST_SERVICE, FEWEST_SERVICES = 2.0, 5  # [s] from ball to ball; one in five at least can be used
LOGS = "selection"  # folder of a run
SESSIONS = 3  # on the rig at most in one go, until all rallies are played: a busy machine ends some by its own faults


def look_up(study: Study, robot: str) -> None:
    """Raises ConfigError where the robot's YAML or a recording is missing or cannot be read."""
    if robot not in (RIG, LOCK_STEP):
        try:
            robots.load_robot(robot)
        except ConfigError as error:
            raise ConfigError(f"robot: {error}") from None
    for player in study.recordings:
        load_recording(study, player)
    if study.identification is not None and study.identification.joints is not None:
        given = Path(study.identification.joints)
        with error_context("identification.joints"):
            load_logs([given / file for file in ROBOT_FILES])


def load_recording(study: Study, player: str) -> Dataset:
    """Balls of a player recorded before the study. Raises ConfigError naming the key and what is wrong."""
    where, path = f"recordings.{player}", study.recording(player)
    with error_context(where):
        measured = read(path)
    if not isinstance(measured, Dataset):
        raise ConfigError(f"{where}: {path} holds start states; measured trajectories are needed")
    return measured


class RobotWorld:
    """A robot, as in ``study.robot``, and the people who play with it."""

    def __init__(self, study: Study, robot: str, console: Console) -> None:
        self._study, self._robot, self._console = study, robot, console

    def first_balls(self, player: str, name: str) -> Dataset:
        """Balls of the player recorded before the study, on the rig without a recording those that the virtual player
        serves. Raises ConfigError as ``load_recording`` does."""
        label = Path(name).name
        if player not in self._study.recordings:
            return serve_balls(player, self._study.first_balls, derive_seed(name), label)
        measured = load_recording(self._study, player)
        # Numbered anew: data sets of several rounds are read together, and one name stands for one ball.
        tracks = tuple(replace(t, session=label, name=str(i)) for i, t in enumerate(measured))
        return Dataset(tracks, self._study.recording(player))

    def fine_tune(self, player: str, source: Path, real_updates: int, folder: Path, name: str) -> tuple[Dataset, str]:
        """``mjx-tt finetune``; raises Waiting when the operator stopped it."""
        study = self._study
        settings = study.fine_tuning.model_copy(update={"updates": real_updates, "seed": derive_seed(name)})
        balls = settings.updates * settings.episodes_per_update
        self._console.print(
            f"{name}: {player} to the table, {balls:,} balls for {settings.updates} updates and twice "
            f"{settings.evaluation_balls} to compare; the operator's keys are those of mjx-tt finetune",
            highlight=False,
            soft_wrap=True,
        )
        opponent = player if self._robot == RIG else None
        setup = RobotOptions(seed=derive_seed(name), player=opponent)
        found = tuning.finetune(str(source), settings, Run(folder), self._robot, self._console, setup)
        if found is None:
            raise Waiting(f"{name}: fine-tuning with {player} is not finished; the same command goes on with it")
        measured = measurements.read_trajectories([folder / loop.HUMAN_BALLS])
        change = found["difference"]["mean_return"]
        return measured, f"{settings.updates} updates, {len(measured):,} balls, mean return changed by {change:+.2f}"

    def hits(self, player: str, source: Path, folder: Path, name: str) -> HitLog:
        """The last balls of the fine-tuning in ``folder``, from the longest session's log."""
        found = sorted(folder.glob("*.mcap"), key=lambda path: path.stat().st_size)
        if not found:
            raise RunError(f"{folder}: holds no session's log (.mcap), of which the simulation is identified")
        flights, joints = session_logs.load(found[-1])
        strokes = (stroke for t in flights for stroke in session_logs.split_by_stroke(t))
        kept = sorted((t for t in strokes if len(t) >= LEAST_SAMPLES), key=lambda t: t.time[0])[-BALLS:]
        if not kept or not joints:
            raise RunError(f"{found[-1]}: holds {len(kept)} balls and {len(joints)} joints; both are needed")
        begin, end = kept[0].time[0] - AROUND, max(t.time[-1] for t in kept) + AROUND
        tracks = tuple(replace(t, session=name, name=str(i)) for i, t in enumerate(kept))
        return HitLog(Dataset(tracks, name), tuple(r.between(begin, end) for r in joints))

    def score(self, player: str, name: str) -> Callable[[TrainedPolicy], float]:
        """Function that scores a policy on the robot."""
        balls, seed = self._study.simulation.selection_episodes, derive_seed(name)
        self._console.print(f"{name}: {player} to the table", highlight=False)
        return lambda p: score(p, self._robot, balls, seed, self._console)


class StandStill:
    """A policy that does not move."""

    def reset(self) -> None:
        pass

    def step(self, observation: np.ndarray) -> np.ndarray:
        return np.zeros(len(observation) - 3)


def serve_balls(player: str, count: int, seed: int, session: str) -> Dataset:
    """Balls that a virtual player serves, as the emulated trackers measured them; the robot stands still."""
    recorder = BallRecorder()
    rig = LockStep(SCENE, VirtualPlayer(player, seed), StandStill(), RigParams(seed=seed % 2**31), recorder=recorder)
    rig.throwing = True
    found: tuple[Trajectory, ...] = ()
    while len(found) < count:
        before = len(found)
        rig.run(LONGEST_SERVICE * max(count - before, FEWEST_SERVICES))
        tracks = (recorder.trajectory(ball) for ball in recorder.balls)
        whole = [track for track in tracks if len(track) >= LEAST_SAMPLES]
        found = tuple(Trajectory(session, str(i), t[:, 0], t[:, 1:].T) for i, t in enumerate(whole[:count]))
        if len(found) == before:
            raise RunError(f"{player} serves no ball on the rig")
    return Dataset(tuple(before_racket(t) for t in found), f"{player} on the rig")


def export_once(trained: TrainedPolicy, console: Console) -> Path:
    """The artefact of a run, exported if it has none. Raises ConfigError for a policy that the robot cannot run."""
    folder = Run(trained.source).artefact
    if not (folder / artefacts.MANIFEST).exists():
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
