"""Trains one run: the loop around the compiled update with its measurements, checkpoints, stops and resumption."""

from __future__ import annotations

import json
import signal
import threading
import time
from contextlib import nullcontext
from typing import Any, NoReturn

import jax
import numpy as np
from jax.stages import Compiled
from numpy.typing import ArrayLike
from rich.console import Console

from bgs import normalizer
from experiments.config import build
from experiments.config.build import Experiment
from experiments.config.experiment import Config
from experiments.errors import CheckpointError, ConfigError, RunError, error_context
from experiments.evaluation.evaluate import draw_balls, return_rate
from experiments.interrupts import stop_requested
from experiments.progress import TrainingProgress
from experiments.runs import checkpoint, load_policy, run_dir
from experiments.runs.metrics import MetricsLog
from experiments.runs.run_dir import Run
from experiments.training.first_order import FirstOrderTrainer
from experiments.training.ranks import SINGLE, Ranks, Watchdog
from experiments.training.update import Trainer, TrainState
from mjx_tt.env.evaluator import Evaluator
from mjx_tt.env.policy import Policy
from mjx_tt.env.rollout import Simulator, held_here
from mjx_tt.sim import arguments

_programs: dict[str, Compiled] = {}  # compiled updates by what decides them
CTRL_C = "Ctrl-C: saves a checkpoint and stops after this update or compilation; Ctrl-C again ends at once"
FETCH_SECONDS = 1.0  # between fetches of measurements: each one waits for the device, which then idles for a moment
KINDS: dict[str, type[Trainer]] = {"zeroth_order": Trainer, "first_order": FirstOrderTrainer}  # by optimiser.gradient
QUEUED = 16  # updates between fetches where several devices take part: hundreds of queued collectives may hang


def make_trainer(experiment: Experiment) -> Trainer:
    """The trainer that an experiment asks for, with its pool of balls drawn. Raises ConfigError."""
    config = experiment.config
    with error_context("training.devices"):
        simulator = Simulator(experiment.task, build.device_count(config))
    return KINDS[config.optimiser.gradient](
        simulator,
        experiment.bgs,
        build.pool(experiment, build.key(config.training.seed, build.TRAINING_BALLS), config.training.pool),
        experiment.model.model,
        experiment.model.randomise,
        config.optimiser.repeats,
        config.optimiser.common_random_numbers,
        config.optimiser.initial_scale,
        build.later_weights(config),
        experiment.network,
    )


def train(experiment: Experiment, run: Run, console: Console, ranks: Ranks = SINGLE) -> str:
    """Trains until the configuration says stop, continuing from the last checkpoint; returns the setting that ended it.

    ranks: the processes that train it together; only the first one touches the run's folder. Ctrl-C or SIGTERM saves a
    checkpoint first and then raises KeyboardInterrupt. Raises RunError, ConfigError or CheckpointError with a message
    for the person at the terminal.
    """
    if ranks.is_first:
        run.open(experiment.config)
    with run.locked() if ranks.is_first else nullcontext():
        try:
            return TrainingRun(experiment, run, console, ranks).train()
        except OSError as error:  # of the measurements; checkpoints raise their own
            raise RunError(
                f"{error.filename or run.metrics}: cannot be written: {error.strerror or error}; "
                "the last checkpoint is whole. Make room or repair the folder, then run the same command again to "
                "continue"
            ) from error


class TrainingRun:
    """A run between two starts of the program.

    state        after ``update`` updates
    seconds      of training in all sessions, without compilation and evaluations
    return_rate  of the last evaluation during training, None before the first
    """

    def __init__(self, experiment: Experiment, run: Run, console: Console, ranks: Ranks = SINGLE) -> None:
        self._config, self._run, self._console, self._ranks = experiment.config, run, console, ranks
        self._trainer = make_trainer(experiment)
        self.state, notes = _start(self._config, run, self._trainer, ranks)
        self.update, self.seconds, self.return_rate = notes["update"], notes["seconds"], notes["return_rate"]
        self._saved = (self.update, time.monotonic())
        self._done = (self.state, self._notes())  # of the last update that is known to have ended
        self._batch = 1  # updates between fetches, from the measured rate
        self._evaluator = self._make_evaluator(experiment)

    def train(self) -> str:
        name, training, first = str(self._run.folder), self._config.training, self._ranks.is_first
        log = MetricsLog(self._run.metrics, self._run.tensorboard, self.update) if first else None
        progress = TrainingProgress(
            self._console, name, training.updates, self.update, self._trainer.episodes_per_update
        )
        try:
            with (
                progress,
                stop_requested(signal.SIGINT, signal.SIGTERM, message=CTRL_C) as stop,
                self._ranks.watch(self._exit_stuck) as watchdog,
            ):
                if self.update:
                    progress.note(f"continues after update {self.update}")
                began = time.monotonic()
                compiled = _compiled(self._config, self._trainer, self.state)
                progress.note(f"compiled in {time.monotonic() - began:.1f} s")
                while True:
                    stopped = self._agree(stop.is_set())
                    reason = run_dir.training_ended(self._config, self.update, self.seconds, self.return_rate)
                    if stopped or reason is not None:
                        break
                    self._advance(compiled, log, progress, stop, watchdog)
                self._save(log)
        except (RuntimeError, ValueError) as error:  # as which JAX raises what gloo says differs
            if self._ranks.is_alone or "Gloo" not in str(error):
                raise
            self._exit_alone(f"another process is lost ({str(error).splitlines()[0]})")
        finally:
            if log is not None:
                log.close()
        if reason is None:
            raise KeyboardInterrupt(f"{name}: stopped after update {self.update}; the same command continues it")
        if first:
            run_dir.write_json(self._run.status, {"reason": reason, **self._notes()})
        return reason

    def _agree(self, stop: bool) -> bool:
        """True where a process was asked to stop; all go on with the first one's seconds and pace."""
        every = self._ranks.gather(stop, self.seconds, self._batch)
        self.seconds, self._batch = float(every[0, 1]), int(every[0, 2])
        return bool(every[:, 0].any())

    def _exit_stuck(self, seconds: float) -> NoReturn:
        self._exit_alone(f"another process is stuck: no update for {seconds:.0f} s")

    def _exit_alone(self, text: str) -> NoReturn:
        """Ends this process after the others: whoever reaches the run's folder saves what is complete."""
        state, notes = self._done
        try:
            if self._run.checkpoints.parent.is_dir() and checkpoint.newest(self._run.checkpoints) < notes["update"]:
                checkpoint.save(self._run.checkpoints, notes["update"], state, notes)
            text += f"; the checkpoint after update {checkpoint.newest(self._run.checkpoints)} is kept"
        except (OSError, CheckpointError) as error:
            text += f"; no checkpoint: {error}"
        self._ranks.exit(f"{text}. The same command continues, with as many processes as you like")

    def _advance(
        self,
        compiled: Compiled,
        log: MetricsLog | None,
        progress: TrainingProgress,
        stop: threading.Event,
        watchdog: Watchdog,
    ) -> None:
        """Updates until it is time to look at them; then measurements, evaluation and checkpoint as they are due."""
        training, every = self._config.training, self._config.training.evaluate_every
        first, began, waiting = self.update + 1, time.monotonic(), []
        while True:
            self.state, measured = compiled(self.state, self._trainer.inputs)
            waiting.append(measured)
            self.update += 1
            evaluation_due = every is not None and self.update % every == 0
            stopped = self._ranks.is_alone and stop.is_set()  # several would stop at different updates
            if evaluation_due or self.update == training.updates or len(waiting) >= self._batch or stopped:
                break
        fetched = jax.device_get(waiting)
        took = time.monotonic() - began
        share = took / len(fetched)
        rows = [
            {"update": first + i, "seconds": round(self.seconds + (i + 1) * share, 4)}
            | {name: _round(value) for name, value in row.items()}
            for i, row in enumerate(fetched)
        ]
        self.seconds += took
        self._batch = max(1, round(FETCH_SECONDS / share))
        if self._trainer.simulator.devices > 1:
            self._batch = min(self._batch, QUEUED)
        self._done = (self.state, self._notes())
        watchdog.beat()
        if evaluation_due and self._evaluator is not None:
            watchdog.pause()
            rows[-1] |= self._evaluate(self._evaluator)
        if log is None:
            return
        log.write(rows)
        progress.updated(self.update, len(rows), took, rows[-1]["return_rate"])
        if time.monotonic() - self._saved[1] >= training.checkpoint_seconds:
            self._save(log)

    def _make_evaluator(self, experiment: Experiment) -> Evaluator | None:
        training = self._config.training
        if training.evaluate_every is None:
            return None
        key = build.key(training.seed, build.PROGRESS_BALLS)
        simulator, model = self._trainer.simulator, experiment.model
        balls = draw_balls(experiment, simulator, training.evaluate_episodes, key)
        return Evaluator(simulator, balls, model.model, model.randomise)

    def _evaluate(self, evaluator: Evaluator) -> dict[str, float]:
        """The averaged parameters on the run's own set of fresh balls."""
        key = build.key(self._config.training.seed, build.PROGRESS_EPISODES)
        state = held_here(self.state)
        policy = Policy(state.bgs.average, *normalizer.normaliser(state.statistics), self._trainer.network)
        result = evaluator.play(policy, key)
        rate = return_rate(result)
        self.return_rate = rate.value
        return {"evaluation/return_rate": rate.value, "evaluation/low": rate.low, "evaluation/high": rate.high}

    def _notes(self) -> dict[str, Any]:
        return {"update": self.update, "seconds": round(self.seconds, 4), "return_rate": self.return_rate}

    def _save(self, log: MetricsLog | None) -> None:
        if log is not None and (self._saved[0] != self.update or not self.update):
            log.sync()
            checkpoint.save(self._run.checkpoints, self.update, self.state, self._notes())
        self._saved = (self.update, time.monotonic())


def program(config: Config, devices: int | str) -> str:
    """Everything that decides an update's program."""
    made = build.experiment(config, config.name)
    whole, training = made.config.to_dict(), config.training
    numbers = arguments.structure(made.model.model, made.model.randomise)
    sections = [whole["task"], numbers, whole["optimiser"], whole["robot"]]
    length = training.updates if config.optimiser.step.schedule.kind == "cosine" else None
    rest: list[Any] = [length, training.pool, devices, made.config.definitions, config.network]
    if training.later_rewards is not None:
        rest.append(training.later_rewards.to_dict())
    return json.dumps([*sections, *rest], sort_keys=True)


def _compiled(config: Config, trainer: Trainer, state: TrainState) -> Compiled:
    """The update's program: one for all runs of this process that differ in balls, numbers, seed and first policy."""
    decides = program(config, trainer.simulator.devices)
    if decides not in _programs:
        _programs[decides] = trainer.lower(state).compile()
    return _programs[decides]


def _start(config: Config, run: Run, trainer: Trainer, ranks: Ranks) -> tuple[TrainState, dict[str, Any]]:
    """The last checkpoint's state and notes, or the first ones."""
    theta = statistics = None
    if config.initial_policy is not None:
        _check_network(config, trainer, str(run.folder))
        theta, statistics = load_policy.load_statistics(config.initial_policy)
    key = build.key(config.training.seed, build.INITIAL_STATE)
    with error_context(f"initial_policy: {config.initial_policy}"):
        state = trainer.init(key, theta, statistics)
    notes: dict[str, Any] = {"update": 0, "seconds": 0.0, "return_rate": None}
    if ranks.is_first:
        state, notes = checkpoint.load_latest(run.checkpoints, state) or (state, notes)
    state, notes = _broadcast(ranks, state, notes)
    # Where the update leaves its results: compiled for this placement, it can be fed what it returns.
    return trainer.simulator.replicate(state), notes


def _check_network(config: Config, trainer: Trainer, where: str) -> None:
    """Raises ConfigError where the policy to start from is another network's: its numbers would mean something else.

    Name and shapes decide: the file may have changed since.
    """
    networks = load_policy.load(str(config.initial_policy)).policy.network, trainer.network
    given, wanted = (None if n is None else (n.name, n.shapes) for n in networks)
    if given != wanted:
        called = ["the paper's" if n is None else f"{n[0]} {n[1]}" for n in (given, wanted)]
        raise ConfigError(
            f"{where}: initial_policy: {config.initial_policy}: its network is {called[0]}, the experiment's is "
            f"{called[1]}"
        )


def _broadcast(ranks: Ranks, state: TrainState, notes: dict[str, Any]) -> tuple[TrainState, dict[str, Any]]:
    """The first process' state and notes, which alone reads the run's folder."""
    if ranks.is_alone:
        return state, notes
    rate = np.nan if notes["return_rate"] is None else notes["return_rate"]
    update, seconds, rate = ranks.gather(notes["update"], notes["seconds"], rate)[0].tolist()
    state = checkpoint.unpack(ranks.broadcast(checkpoint.pack(state)), state, "process 0")
    return state, {"update": int(update), "seconds": seconds, "return_rate": None if np.isnan(rate) else rate}


def _round(value: ArrayLike) -> float | None:
    """Six digits, None where not finite: JSON has no NaN."""
    number = float(np.asarray(value))
    return float(f"{number:.6g}") if np.isfinite(number) else None
