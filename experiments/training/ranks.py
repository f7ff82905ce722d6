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
SILENCE = 20.0  # [s] without an update, or PATIENT times the longest wait so far, until a process counts as stuck
PATIENT = 5.0
HEARTBEAT = 60  # [s] after which JAX itself ends all processes of a lost one: where nobody counts updates
ENDING = 20  # [s] to wait for the others at the end


@dataclass(frozen=True)
class Ranks:
    """Processes that compute together; ``own`` counts from 0, the first one."""

    count: int = 1
    own: int = 0

    @property
    def first(self) -> bool:
        return self.own == 0

    @property
    def alone(self) -> bool:
        return self.count == 1

    def agree(self, *values: float) -> np.ndarray:
        """(count, n) the values of every process, to the last bit; each one waits here for all."""
        mine = np.array(values, np.float64)[None]
        return mine if self.alone else _gathered(mine.view(np.uint8)).view(np.float64)

    def of_first(self, arrays: list[np.ndarray]) -> list[np.ndarray]:
        """The first process' arrays in place of each one's own, which have the same shapes and types."""
        if self.alone:
            return arrays
        mine = np.frombuffer(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays), np.uint8)
        theirs, out, place = _gathered(mine[None])[0].tobytes(), [], 0
        for a in arrays:
            out.append(np.frombuffer(theirs, a.dtype, a.size, place).reshape(a.shape))
            place += a.nbytes
        return out

    def part(self) -> None:
        """The end of the common work, for which each one waits; afterwards every process has its own devices only."""
        if not self.alone:
            jax.distributed.shutdown()

    @contextmanager
    def together(self) -> Iterator[None]:
        """Inside, an error of one process ends it at once, so that the others notice instead of waiting for it."""
        try:
            yield
        except Exception as error:
            if self.alone:
                raise
            if not explained(error):
                traceback.print_exc()
            self.leave(str(error) or type(error).__name__)

    def leave(self, text: str) -> NoReturn:
        """Ends this process, from any thread, without the wait for the others that a usual end begins with."""
        print(f"error: process {self.own} of {self.count}: {text}", file=sys.stderr, flush=True)
        sys.stdout.flush()
        os._exit(1)

    @contextmanager
    def watched(self, silent: Callable[[float], NoReturn]) -> Iterator[Watch]:
        """A watch over the others; ``silent`` is called with the seconds waited, from another thread."""
        watch = Watch(silent)
        if not self.alone:
            watch.start()
        try:
            yield watch
        finally:
            watch.end()


class Watch(threading.Thread):
    """Calls out when nothing was heard for too long: a process that hangs leaves the others waiting inside a call.

    It begins with the second sign of life, since the first updates wait for compilations.
    """

    def __init__(self, silent: Callable[[float], NoReturn]) -> None:
        super().__init__(daemon=True)
        self._silent, self._over = silent, threading.Event()
        self._heard, self._longest = float("inf"), 0.0

    def alive(self) -> None:
        """A sign of life."""
        now = time.monotonic()
        self._longest = max(self._longest, now - self._heard)
        self._heard = now

    def pause(self) -> None:
        """No sign is due until the next one."""
        self._heard = float("inf")

    def end(self) -> None:
        self._over.set()

    def run(self) -> None:
        while not self._over.wait(0.5):
            waited = time.monotonic() - self._heard
            if waited > max(SILENCE, PATIENT * self._longest):
                self._silent(waited)


ALONE = Ranks()


def join(where: str, processes: int | None, process: int | None) -> Ranks:
    """Joins the processes; JAX must be configured and not yet running.

    where: "auto" under SLURM, Open MPI or Kubernetes, which say who takes part; otherwise HOST:PORT of the first
    process, which listens there and nowhere else. Raises ConfigError.
    """
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
        ranks.agree(0.0)
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


def _gathered(mine: np.ndarray) -> np.ndarray:
    """(count, bytes) of every process."""
    return np.ascontiguousarray(multihost_utils.process_allgather(mine, tiled=True))
