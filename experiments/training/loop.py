"""Trains one run: the loop around the compiled update with its measurements, checkpoints, stops and resumption."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

import jax
import numpy as np
from jax.stages import Compiled
from numpy.typing import ArrayLike
from rich.console import Console

from bgs import normalizer
from experiments import stages
from experiments.config import build
from experiments.config.build import Experiment
from experiments.config.experiment import Config
from experiments.errors import RunError
from experiments.evaluation.evaluate import draw_balls, return_rate
from experiments.runs import checkpoint, load_policy, run_dir
from experiments.runs.metrics import MetricsLog
from experiments.runs.run_dir import Run
from experiments.training.progress import TrainingProgress
from experiments.training.update import Trainer, TrainState, trainer
from mjx_tt.env.evaluator import Evaluator
from mjx_tt.env.policy import Policy

_programs: dict[str, Compiled] = {}  # compiled updates by what decides them
FETCH_SECONDS = 1.0  # between fetches of measurements: each one waits for the device, which then idles for a moment


def train(experiment: Experiment, run: Run, console: Console) -> str:
    """Trains until the configuration says stop, continuing from the last checkpoint; returns the setting that ended it.

    Ctrl-C or SIGTERM saves a checkpoint first and then raises KeyboardInterrupt. Raises RunError, ConfigError or
    CheckpointError with a message for the person at the terminal.
    """
    run.open(experiment.config)
    with run.locked():
        try:
            return Session(experiment, run, console).train()
        except OSError as error:  # of the measurements; checkpoints raise their own
            raise RunError(
                f"{error.filename or run.metrics}: cannot be written: {error.strerror or error}; "
                "the last checkpoint is whole. Make room or repair the folder, then run the same command again to "
                "continue"
            ) from error


class Session:
    """A run between two starts of the program.

    state        after ``update`` updates
    seconds      of training in all sessions, without compilation and evaluations
    return_rate  of the last evaluation during training, None before the first
    """

    def __init__(self, experiment: Experiment, run: Run, console: Console) -> None:
        self._config, self._run, self._console = experiment.config, run, console
        self._trainer = trainer(experiment)
        self.state, notes = _start(self._config, run, self._trainer)
        self.update, self.seconds, self.return_rate = notes["update"], notes["seconds"], notes["return_rate"]
        self._saved = (self.update, time.monotonic())
        self._batch = 1  # updates between fetches, from the measured rate
        self._evaluator = self._make_evaluator(experiment)

    def train(self) -> str:
        name, training = str(self._run.folder), self._config.training
        log = MetricsLog(self._run.metrics, self._run.tensorboard, self.update)
        progress = TrainingProgress(
            self._console, name, training.updates, self.update, self._trainer.episodes_per_update
        )
        try:
            with progress, _stop_requests() as stop_wanted:
                if self.update:
                    progress.note(f"continues after update {self.update}")
                began = time.monotonic()
                compiled = _compiled(self._config, self._trainer, self.state)
                progress.note(f"compiled in {time.monotonic() - began:.1f} s")
                while (reason := self._ended()) is None and not stop_wanted():
                    self._advance(compiled, log, progress, stop_wanted)
                self._save(log)
        finally:
            log.close()
        if reason is None:
            raise KeyboardInterrupt(f"{name}: stopped after update {self.update}; the same command continues it")
        run_dir.write_json(self._run.status, {"reason": reason, **self._notes()})
        return reason

    def _ended(self) -> str | None:
        return run_dir.training_ended(self._config, self.update, self.seconds, self.return_rate)

    def _advance(
        self, compiled: Compiled, log: MetricsLog, progress: TrainingProgress, stop_wanted: Callable[[], bool]
    ) -> None:
        """Updates until it is time to look at them; then measurements, evaluation and checkpoint as they are due."""
        training, every = self._config.training, self._config.training.evaluate_every
        first, began, waiting = self.update + 1, time.monotonic(), []
        while True:
            self.state, measured = compiled(self.state, self._trainer.pool)
            waiting.append(measured)
            self.update += 1
            evaluation_due = every is not None and self.update % every == 0
            if evaluation_due or self.update == training.updates or len(waiting) >= self._batch or stop_wanted():
                break
        fetched = jax.device_get(waiting)
        took = time.monotonic() - began
        share = took / len(fetched)
        rows = [
            {"update": first + i, "seconds": round(self.seconds + (i + 1) * share, 4)}
            | {name: _short(value) for name, value in row.items()}
            for i, row in enumerate(fetched)
        ]
        self.seconds += took
        self._batch = max(1, round(FETCH_SECONDS / share))
        if evaluation_due and self._evaluator is not None:
            rows[-1] |= self._evaluate(self._evaluator)
        log.write(rows)
        progress.show(self.update, len(rows), took, rows[-1]["return_rate"])
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
        policy = Policy(self.state.bgs.average, *normalizer.normaliser(self.state.statistics))
        result = evaluator.play(policy, key)
        rate = return_rate(result)
        self.return_rate = rate.value
        return {"evaluation/return_rate": rate.value, "evaluation/low": rate.low, "evaluation/high": rate.high}

    def _notes(self) -> dict[str, Any]:
        return {"update": self.update, "seconds": round(self.seconds, 4), "return_rate": self.return_rate}

    def _save(self, log: MetricsLog) -> None:
        if self._saved[0] != self.update or not self.update:
            log.sync()
            checkpoint.save(self._run.checkpoints, self.update, self.state, self._notes())
        self._saved = (self.update, time.monotonic())


def _compiled(config: Config, trainer: Trainer, state: TrainState) -> Compiled:
    """The update's program: one for all runs of this process that differ in balls, seed and first policy only."""
    sections, training = [config.to_dict()[name] for name in ("task", "model", "optimiser")], config.training
    length = training.updates if config.optimiser.step.schedule.kind == "cosine" else None
    rest = [length, build.later_weights(training), training.pool, trainer.simulator.devices]
    decides = json.dumps([*sections, *rest], sort_keys=True)
    if decides not in _programs:
        _programs[decides] = trainer.lower(state).compile()
    return _programs[decides]


def _start(config: Config, run: Run, trainer: Trainer) -> tuple[TrainState, dict[str, Any]]:
    """The last checkpoint's state and notes, or the first ones."""
    theta = statistics = None
    if config.initial_policy is not None:
        theta, statistics = load_policy.load_statistics(config.initial_policy)
    state = trainer.init(build.key(config.training.seed, build.INITIAL_STATE), theta, statistics)
    notes: dict[str, Any] = {"update": 0, "seconds": 0.0, "return_rate": None}
    state, notes = checkpoint.load_latest(run.checkpoints, state) or (state, notes)
    # Where the update leaves its results: compiled for this placement, it can be fed what it returns.
    return trainer.simulator.replicate(state), notes


def _short(value: ArrayLike) -> float | None:
    """Six digits, None where not finite: JSON has no NaN."""
    number = float(np.asarray(value))
    return float(f"{number:.6g}") if np.isfinite(number) else None


@contextmanager
def _stop_requests() -> Iterator[Callable[[], bool]]:
    """Yields a function that is true once Ctrl-C or SIGTERM has come; a second one acts at once."""
    received = []

    def note(number: int, _frame: FrameType | None) -> None:
        stages.acted_on()
        received.append(number)
        if number == signal.SIGINT:
            stages.say(
                "Ctrl-C: saves a checkpoint and stops after this update or compilation; Ctrl-C again ends at once"
            )
        signal.signal(number, previous[signal.Signals(number)])

    previous = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
