"""Processes that train one policy together on one or several hosts: joining, agreeing, ending when one is lost.

Every process runs the same program on the devices of all of them (``jax.distributed``); the first one alone writes
files and speaks, what it decides by its clock reaches the others before they act on it.
"""

from __future__ import annotations

import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NoReturn

import jax
import numpy as np
from jax.experimental import multihost_utils

from experiments.errors import ConfigError, explained

AUTO = "auto"
SILENCE = 20.0  # [s] without an update, or PATIENT times the longest wait so far: a process is stuck
PATIENT = 5.0
HEARTBEAT = 60  # [s] after which JAX itself ends all processes of a lost one: where nobody counts updates
ENDING = 20  # [s] to wait for the others at the end


@dataclass(frozen=True)
class Ranks:
    """Processes that compute together; ``index`` counts from 0, the first one."""

    count: int = 1
    index: int = 0

    @property
    def is_first(self) -> bool:
        return self.index == 0

    @property
    def is_alone(self) -> bool:
        return self.count == 1

    def gather(self, *values: float) -> np.ndarray:
        """(count, n) the values of every process, to the last bit; each one waits here for all."""
        mine = np.array(values, np.float64)[None]
        return mine if self.is_alone else _gather_bytes(mine.view(np.uint8)).view(np.float64)

    def broadcast(self, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The first process' arrays in place of each one's own, which have the same shapes and types."""

        def first(mine: np.ndarray) -> np.ndarray:
            every = _gather_bytes(np.frombuffer(mine.tobytes(), np.uint8)[None])
            return np.frombuffer(every[0].tobytes(), mine.dtype).reshape(mine.shape)

        return arrays if self.is_alone else {name: first(array) for name, array in arrays.items()}

    def disconnect(self) -> None:
        """Ends the common work, for which each one waits; afterwards every process has its own devices only."""
        if not self.is_alone:
            jax.distributed.shutdown()

    @contextmanager
    def failing_fast(self) -> Iterator[None]:
        """Inside, an error of one process ends it at once, so that the others notice instead of waiting for it."""
        try:
            yield
        except Exception as error:
            if self.is_alone:
                raise
            if not explained(error):
                traceback.print_exc()
            self.exit(str(error) or type(error).__name__)

    def exit(self, text: str) -> NoReturn:
        """Ends this process, from any thread, without the wait for the others that a usual end begins with."""
        print(f"error: process {self.index} of {self.count}: {text}", file=sys.stderr, flush=True)
        sys.stdout.flush()
        os._exit(1)

    @contextmanager
    def watch(self, on_silence: Callable[[float], NoReturn]) -> Iterator[Watchdog]:
        """A watchdog over the others, which calls ``on_silence`` from another thread with the seconds waited."""
        watchdog = Watchdog(on_silence)
        if not self.is_alone:
            watchdog.start()
        try:
            yield watchdog
        finally:
            watchdog.stop()


class Watchdog(threading.Thread):
    """Calls out when no heartbeat came for too long: a process that hangs leaves the others waiting inside a call.

    It begins with the second heartbeat, since the first updates wait for compilations.
    """

    def __init__(self, on_silence: Callable[[float], NoReturn]) -> None:
        super().__init__(daemon=True)
        self._on_silence, self._over = on_silence, threading.Event()
        self._heard, self._longest = float("inf"), 0.0

    def beat(self) -> None:
        now = time.monotonic()
        self._longest = max(self._longest, now - self._heard)
        self._heard = now

    def pause(self) -> None:
        """No heartbeat is due until the next one."""
        self._heard = float("inf")

    def stop(self) -> None:
        self._over.set()

    def run(self) -> None:
        while not self._over.wait(0.5):
            waited = time.monotonic() - self._heard
            if waited > max(SILENCE, PATIENT * self._longest):
                self._on_silence(waited)


SINGLE = Ranks()


def join(where: str | None, processes: int | None, process: int | None) -> Ranks:
    """Joins the processes; JAX must be configured and not yet running.

    where: "auto" under SLURM, Open MPI or Kubernetes, which say who takes part; otherwise HOST:PORT of the first
    process, which listens there and nowhere else; None: there are no others. Raises ConfigError.
    """
    if where is None:
        return SINGLE
    given = f"--distributed {where}"
    if where != AUTO and (processes is None or process is None):
        raise ConfigError(f"{given}: needs --processes N and --process I, I from 0 to N - 1")
    if where == AUTO and (processes is not None or process is not None):
        raise ConfigError(f"{given}: --processes and --process come with HOST:PORT; the cluster says them otherwise")
    if processes is not None and process is not None and not 0 <= process < processes:
        raise ConfigError(f"--process {process}: allowed are 0 to {processes - 1}")
    if where != AUTO and not where.rpartition(":")[2].isdigit():
        raise ConfigError(f"{given}: allowed: auto, or HOST:PORT of the first process")
    jax.config.update("jax_enable_preemption_service", False)  # it would keep SIGTERM, which asks for a checkpoint
    address = None if where == AUTO else where
    try:
        jax.distributed.initialize(
            address,
            coordinator_bind_address=address,
            num_processes=processes,
            process_id=process,
            heartbeat_timeout_seconds=HEARTBEAT,
            shutdown_timeout_seconds=ENDING,
        )
    except (ValueError, RuntimeError) as error:
        hint = "; no SLURM, Open MPI or Kubernetes was found here" if where == AUTO else ""
        raise ConfigError(f"{given}: {error}{hint}") from None
    ranks = Ranks(jax.process_count(), jax.process_index())
    with _quiet_output():  # gloo greets each connection there
        ranks.gather(0.0)
    return ranks


@contextmanager
def _quiet_output() -> Iterator[None]:
    """Keeps what libraries print to standard output, errors not included, from the terminal."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def _gather_bytes(mine: np.ndarray) -> np.ndarray:
    """(count, bytes) of every process."""
    return np.ascontiguousarray(multihost_utils.process_allgather(mine, tiled=True))
