"""Fine-tuning on a robot: Blackbox Gradient Sensing with one ball at a time, which nothing interrupts for good.

Every episode is on the disk before the next begins (``journal``), every update ends with a checkpoint. A run that
was killed continues with the same perturbations and ends, on a robot that repeats itself, in the same parameters bit
for bit. The run's folder is a run like those of training: it can be evaluated, exported and trained from.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
from contextlib import closing
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import yaml
from rich.console import Console

from ballmodel.io.atomic_files import replacing
from bgs import normalizer, strategy
from bgs.normalizer import ObservationStatistics
from experiments.config import build
from experiments.config.build import Experiment
from experiments.config.files import read_yaml
from experiments.config.finetuning import FineTuning
from experiments.errors import RunError
from experiments.finetuning import report
from experiments.finetuning.journal import AFTER, BEFORE, TRAINING, Entry, Journal
from experiments.finetuning.robot import LockStepRobot, Operator, Robot
from experiments.progress import print_files
from experiments.runs import checkpoint, load_policy, metrics, run_dir
from experiments.runs.metrics import MetricsLog
from experiments.runs.run_dir import CONFIG, Run
from experiments.training import finalize
from experiments.training.update import TrainState
from mjx_tt.env import task
from mjx_tt.env.reward_weights import MEASURED_WEIGHTS
from mjx_tt.env.terms import PlayedBall as RewardedBall
from robot_io.contract import JOINT_NAMES
from robot_io.control.episode import HIT, RETURNED, EpisodeSummary
from robot_io.emulator.config import RigParams
from robot_io.emulator.opponent import Throws
from robot_io.policy import jax_policy
from robot_io.policy.policy import Policy

SETTINGS = "finetuning.yaml"
JOURNAL = "journal.jsonl"
HUMAN_BALLS = "human_balls.csv"
CURVE = "finetuning.png"
EVALUATION_EPISODES = 1_000_000  # number of the first evaluation's first episode: other balls than in fine-tuning
LOCK_STEP_BALLS = 65536
PAUSE_POLL = 0.05  # [s]
LATE = 1.0  # [s] after a round in which its last ball can still be discarded
Slot = tuple[str, int, int, int]


def finetune(
    source: str | Path,
    settings: FineTuning,
    run: Run,
    robot: Robot,
    console: Console,
    operator: Operator | None = None,
    experiment: Experiment | None = None,
) -> dict[str, Any] | None:
    """Starts or continues fine-tuning the policy of a run or an artefact; returns the evaluation's report.

    Returns None if the operator stopped it; the same call then continues. experiment: what ``source`` was trained in,
    looked up when it is not given. Raises RunError, ConfigError, CheckpointError or ArtefactError with a message for
    the person at the terminal, and what the robot raises.
    """
    experiment = experiment or experiment_of(source)
    run.folder.mkdir(parents=True, exist_ok=True)
    with run.locked():
        tuning = FineTuningRun(str(source), experiment, settings, run, robot, operator or Operator(), console)
        with closing(tuning.log), run_dir.continuable(run.folder, "every episode before", "it"):
            finished = tuning.run()
        if finished:
            return tuning.conclude()
    console.print(f"{run.folder}: stopped; the same command continues it")
    return None


def experiment_of(source: str | Path, balls: str | None = None) -> Experiment:
    """The experiment that trained a policy, with other balls if given. Raises RunError where it is not recorded."""
    trained = load_policy.load(source)
    if trained.config is None:
        raise RunError(f"{source}: does not say how it was trained; fine-tune the run that it came from")
    changed = {"initial_policy": None} | ({"balls": balls} if balls else {})
    return build.experiment(trained.config.model_copy(update=changed), str(source))


def throws_of(experiment: Experiment, seed: int = 0) -> Throws:
    """Balls of the experiment's distribution for an emulated robot; ``seed`` draws them."""
    pool = build.pool(experiment, build.key(seed, build.EVALUATION_BALLS), LOCK_STEP_BALLS)
    return Throws(*(np.asarray(part, float) for part in (pool.state.position, pool.state.velocity, pool.state.spin)))


def lock_step_robot(experiment: Experiment, params: RigParams | None = None, seed: int = 0) -> LockStepRobot:
    """The emulated robot with balls of the experiment's distribution; ``seed`` draws them."""
    robot = experiment.task.robot
    return LockStepRobot(throws_of(experiment, seed), params, robot.scene(), robot.contract)


def reward_terms(summary: EpisodeSummary) -> dict[str, float]:
    """The terms of an episode on a robot, unweighted, by the functions of the simulation; others are not measured."""
    played = RewardedBall(
        hit=summary.outcome in (HIT, RETURNED),
        crossed=np.bool_(summary.crossed),
        returned=summary.outcome == RETURNED,
        net_height=summary.net_height,
        landing=np.array(summary.landing, np.float32),
        closest=np.float32(summary.closest),
        steps=math.nan,
        peak_velocity=np.full(len(JOINT_NAMES), math.nan),
        fault=bool(summary.fault),
    )
    return {term.name: float(term(played)) for term in task.BUILT_IN_REWARDS if term.name in MEASURED_WEIGHTS}


def observed(summary: EpisodeSummary) -> ObservationStatistics:
    """Statistics of what the policy saw in an episode of at least one step."""
    sums, squares = np.reshape(summary.observed, (2, -1))
    mean = sums / summary.steps
    m2 = np.maximum(squares - summary.steps * mean**2, 0.0)
    count = jnp.array([0, summary.steps], jnp.int32)
    return ObservationStatistics(count, *(jnp.asarray(x, jnp.float32) for x in (mean, m2)))


class FineTuningRun:
    """A fine-tuning between two starts of the program.

    journal  every episode so far
    state    after ``update`` updates
    log      of the measurements, to be closed
    """

    def __init__(
        self,
        source: str,
        experiment: Experiment,
        settings: FineTuning,
        run: Run,
        robot: Robot,
        operator: Operator,
        console: Console,
    ) -> None:
        self._experiment, self._settings, self._run, self._robot = experiment, settings, run, robot
        self._operator, self._console = operator, console
        self._bgs = build.bgs_config(settings.optimiser(), settings.updates)
        self._weights = {term.name: term.weight for term in build.reward_terms(settings.rewards)}
        network = load_policy.load(source).policy.network
        self._network = None if network is None else jax_policy.exported(network)
        theta, statistics = load_policy.load_statistics(source)
        initial = strategy.init(theta.astype(np.float32), self._bgs)
        first = TrainState(initial, statistics, build.key(settings.seed, build.INITIAL_STATE))
        self._open(source, first)
        found = checkpoint.load_latest(run.checkpoints, first)
        self.state, notes = found or (first, {"update": 0, "seconds": 0.0})
        self.update, self._seconds = notes["update"], notes["seconds"]
        self.journal = Journal(run.folder / JOURNAL)
        self._played = {entry.slot: entry for entry in self.journal.entries if not entry.discarded}
        if self.update > settings.updates:
            raise RunError(
                f"{run.folder}: has {self.update} updates already, updates = {settings.updates} does not fit"
            )
        self.log = MetricsLog(run.metrics, run.tensorboard, self.update)
        planned = 2 * settings.evaluation_balls + settings.updates * settings.episodes_per_update
        self._progress = report.FineTuningProgress(console, str(run.folder), planned, settings)
        self._moment = time.monotonic()

    def run(self) -> bool:
        """Plays what is still to be played; False when the operator stopped it."""
        with self._progress as progress:
            progress.resumed(len(self._played), len(self.journal.entries))
            if not self._evaluate(BEFORE):
                return False
            while self.update < self._settings.updates:
                if not self._advance():
                    return False
            return self._evaluate(AFTER)

    def _evaluate(self, phase: str) -> bool:
        """Episodes of the unperturbed policy; False when the operator stopped it."""
        played_before = phase == BEFORE and self.update > 0  # before the first update: only read
        theta = None if played_before else np.asarray(self.state.bgs.average)
        update = 0 if phase == BEFORE else self.update
        slots = [(phase, update, 0, ball) for ball in range(self._settings.evaluation_balls)]
        entries = self._play_all(dict.fromkeys(slots, theta))
        if entries is not None:
            self._progress.note(f"{phase} fine-tuning: {report.sentence(report.evaluated(entries))}")
        return entries is not None

    def _advance(self) -> bool:
        """One update; False when the operator stopped it."""
        settings, number, pairs = self._settings, self.update + 1, self._settings.num_directions
        population = strategy.ask(jax.random.fold_in(self.state.key, self.update), self.state.bgs, self._bgs)
        members = np.asarray(population.members)
        # The members take turns, so that a person who tires or warms up is the same to both of a pair.
        entries = self._play_all(
            {
                (TRAINING, number, member, repeat): members[:, member]
                for repeat in range(settings.repeats)
                for pair in range(pairs)
                for member in (pair, pairs + pair)
            }
        )
        if entries is None:
            return False
        returns = np.zeros(2 * pairs)
        for entry in entries:
            returns[entry.member] += entry.returns / settings.repeats
        bgs, info = strategy.tell(self.state.bgs, population, jnp.asarray(returns, jnp.float32), self._bgs)
        statistics = self.state.statistics
        if settings.observation_statistics == "merged":
            statistics = reduce(normalizer.merge, (observed(e.summary) for e in entries if e.summary.steps), statistics)
        self.state, self.update = TrainState(bgs, statistics, self.state.key), number
        now = time.monotonic()
        self._seconds, self._moment = self._seconds + now - self._moment, now
        row = {"update": number, "seconds": round(self._seconds, 3)} | report.update_row(entries)
        row |= {name: float(getattr(info, name)) for name in ("gradient_norm", "update_norm", "elite_std")}
        self.log.write([row])
        self.log.sync()
        checkpoint.save(self._run.checkpoints, number, self.state, {"seconds": self._seconds})
        self._progress.updated(number, row)
        return True

    def _play_all(self, members: dict[Slot, np.ndarray | None]) -> list[Entry] | None:
        """The episodes of a round, by slot and parameters: from the journal or played now; None: the operator stopped.

        A ball that the operator discards after it was credited is played again before the round is used.
        """
        while missing := [slot for slot in members if slot not in self._played]:
            for slot in missing:
                if not self._episode(slot, members[slot]):
                    return None
            if self._operator.retracts(LATE):
                self._retract(missing[-1])
        return [self._played[slot] for slot in members]

    def _retract(self, slot: Slot) -> None:
        """Marks the newest ball in the journal as discarded, where it belongs to the same round as ``slot``."""
        entry = self.journal.entries[-1]
        if entry.slot[:2] != slot[:2]:
            self._progress.note("the ball before belongs to a round that is over: it counts")
        elif self._played.pop(entry.slot, None):
            self.journal.append(replace(entry, discarded=True))
            self._progress.retracted()

    def _episode(self, slot: Slot, theta: np.ndarray | None) -> bool:
        """Plays the episode of that slot until it counts; False when the operator stopped before it."""
        while slot not in self._played:
            while self._operator.paused() and not self._operator.stopped():
                self._progress.paused()
                time.sleep(PAUSE_POLL)
            if self._operator.stopped():
                return False
            if theta is None:
                raise RunError(
                    f"{self.journal.path}: an episode of the evaluation before fine-tuning is missing, though updates "
                    "are done; restore the file or start a new run"
                )
            # A ball that is played again is another one: every attempt counts. The balls of the evaluations before and
            # after are the same, where the robot can.
            phase, update = slot[:2]
            if phase == TRAINING:
                number = sum(entry.phase == TRAINING for entry in self.journal.entries)
            else:
                attempts = sum(entry.slot[:2] == (phase, update) for entry in self.journal.entries)
                number = EVALUATION_EPISODES + attempts
            # As float32 numbers they are those of the exported policy.
            mean, inv_std = (np.asarray(a) for a in normalizer.normaliser(self.state.statistics))
            played = self._robot.play(Policy(np.ascontiguousarray(theta), mean, inv_std, self._network), number)
            if self._operator.retracts():
                self._retract(slot)
            summary, terms = played.summary, reward_terms(played.summary)
            returns = sum(self._weights[name] * value for name, value in terms.items())
            discarded = self._operator.discarded() or summary.unfit  # asked in any case: it is about this ball
            entry = Entry(*slot, number, summary, terms, returns, discarded, played.trajectory)
            self.journal.append(entry)
            if not entry.discarded:
                self._played[slot] = entry
            self._progress.played(entry)
        return True

    def conclude(self) -> dict[str, Any]:
        """Evaluation, picture, the human's balls and the artefact of a fine-tuning that is over; returns the report."""
        run, settings, entries = self._run, self._settings, self.journal.entries
        result = report.compare(entries, self._robot.repeatable)
        result |= {"settings": settings.model_dump(mode="json"), "robot": self._robot.describe()}
        kept = [entry for entry in entries if not entry.discarded]
        title, rows = f"{run.folder.name}: fine-tuning on a robot", metrics.read(run.metrics)
        picture = report.draw(run.plots / CURVE, rows, settings.episodes_per_update, result, title)
        # Balls that a repeatable robot meets before and after are the same.
        human = [entry for entry in kept if entry.phase != AFTER or not self._robot.repeatable]
        balls = report.write_human_balls(run.folder / HUMAN_BALLS, run.folder.name, human)
        tuned = load_policy.load(run.folder)
        exported = finalize.export_policy(run.artefact, tuned, self._experiment, result, self._console)
        run_dir.write_json(run.evaluation, result)
        report.print_result(self._console, result, str(run.folder))
        files = {
            "evaluation": run.evaluation,
            "curve": picture,
            "balls": f"{run.folder / HUMAN_BALLS} ({balls:,}; mjx-tt fit-human makes a distribution of them)",
            "artefact": run.artefact if exported else None,
        }
        print_files(self._console, files)
        return result

    def _open(self, source: str, first: TrainState) -> None:
        """Records what the run is, or checks that it is the one that is asked for. Raises RunError naming differences.

        Before the first ball there is nothing to protect: a failed start must not stand in a corrected one's way.
        """
        folder, settings = self._run.folder, self._settings
        path, journal = folder / SETTINGS, folder / JOURNAL
        arrays = (first.bgs.theta, *normalizer.normaliser(first.statistics))
        wanted = {
            "source": source,
            "policy": hashlib.sha256(b"".join(np.asarray(a, np.float32).tobytes() for a in arrays)).hexdigest(),
            "robot": self._robot.describe(),
            "settings": settings.model_dump(mode="json"),
        }
        if path.exists() and journal.exists() and journal.stat().st_size > 0:
            found = read_yaml(path.read_text(encoding="utf-8"), str(path))
            # A run that an earlier version began has the defaults of keys that came later.
            found = found | {"settings": FineTuning().model_dump(mode="json") | (found.get("settings") or {})}
            longer = {"settings.updates"} if settings.step.schedule.kind == "constant" else set()
            changeable = longer | {"source"}  # the policy itself is compared
            if changed := run_dir.differences(found, wanted, changeable.__contains__):
                raise RunError(
                    f"{folder}: is another fine-tuning:\n{changed}\nRestore these values or choose another --out"
                )
        elif not path.exists() and (folder / CONFIG).exists():
            raise RunError(f"{folder}: is a run of another kind; choose another --out")
        config = self._experiment.config.model_copy(
            update={"name": folder.name, "initial_policy": str(Path(source).resolve())}
        )
        for target, data in ((path, wanted), (folder / CONFIG, config.to_dict())):
            with replacing(target) as temporary, open(temporary, "w", encoding="utf-8") as file:
                yaml.safe_dump(data, file, sort_keys=False)
                file.flush()
                os.fsync(file.fileno())
