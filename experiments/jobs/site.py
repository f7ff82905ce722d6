"""Workers of jobs: processes of this machine by ``concurrent.futures``, or those of a site (--site) by Parsl."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from multiprocessing import get_context
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax

from experiments.config.site import OWN, Local, Site
from experiments.errors import ConfigError, RunError
from experiments.jobs import worker
from experiments.jobs.engine import Engine, Job, Setup

if TYPE_CHECKING:
    from parsl.executors import HighThroughputExecutor
    from parsl.providers.base import ExecutionProvider

HEARTBEAT_PERIOD = 5  # [s] between looks of a host at its workers, and between signs that it lives
HEARTBEAT_TIMEOUT = 60  # [s] without a sign after which a host is given up, or gives itself back


@dataclass(frozen=True)
class Workers:
    """Workers that a command was given: ``processes`` of this machine, or those of a site.

    where: the site's file, for messages
    """

    processes: int = 1
    site: Site | None = None
    where: str = OWN

    @property
    def alone(self) -> bool:
        """True where the process that was asked does all jobs itself, one after the other."""
        return self.site is None and self.processes == 1

    @property
    def count(self) -> int:
        """Jobs at a time."""
        return self.processes if self.site is None else self.site.workers

    @property
    def cores(self) -> int:
        """Of each worker."""
        if self.site is not None:
            return self.site.cores_per_worker
        return max(1, len(os.sched_getaffinity(0)) // self.processes)

    @property
    def text(self) -> str:
        """The workers, in words."""
        kind = "process" if self.site is None else f"worker of {self.where}"
        kinds = "processes" if self.site is None else f"workers of {self.where}"
        return f"{self.count} {kind if self.count == 1 else kinds} at a time"

    def engine(self, setup: Setup, folder: Path) -> Engine:
        """Starts them; ``folder`` is that of the results. Raises ConfigError where the site cannot be used."""
        cache = jax.config.values["jax_compilation_cache_dir"]
        if self.site is None:
            return PoolEngine(replace(setup, cache=cache), folder, self.processes)
        return ParslEngine(replace(setup, cache=self.site.cache or cache), folder, self.site, self.where)


ALONE = Workers()


def count_processes(jobs: int, asked: int | None, alone: bool) -> int:
    """Processes of this machine for so many jobs: as many as were asked for; else one per core.

    One where a job should be ``alone``, or on an accelerator. Call it when JAX is configured.
    """
    if asked is None:
        asked = 1 if alone or jax.default_backend() != "cpu" else len(os.sched_getaffinity(0))
    return min(asked, jobs)


class PoolEngine(Engine):
    """Processes of this machine, each on its share of the cores."""

    replaces = False

    def __init__(self, setup: Setup, folder: Path, processes: int) -> None:
        super().__init__(setup, folder)
        self.slots, self._where = processes, folder
        context = get_context("spawn")  # a fork of a process in which JAX has run hangs
        shares: SimpleQueue[list[int]] = context.SimpleQueue()
        cores = sorted(os.sched_getaffinity(0))
        for i in range(processes):
            shares.put(cores[i::processes] or cores)
        self._pool = ProcessPoolExecutor(processes, context, worker.start_local, (shares,))

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        try:
            return self._pool.submit(function, *arguments)
        except BrokenProcessPool as error:  # of which a process was killed in another job
            done: Future[Any] = Future()
            done.set_exception(error)
            return done

    def explain(self, job: Job, error: BaseException) -> BaseException:
        if not isinstance(error, BrokenProcessPool):
            return error
        return RunError(
            f"{self._where}: a process was killed, probably out of memory; what is finished is kept. "
            "The same command continues, --processes with fewer needs less memory"
        )

    def end(self) -> None:
        self._pool.shutdown(cancel_futures=True)


class ParslEngine(Engine):
    """Workers of a site. Raises ConfigError where the site's commands are not here."""

    replaces = True

    def __init__(self, setup: Setup, folder: Path, site: Site, where: str) -> None:
        import parsl

        super().__init__(setup, folder)
        self.slots, self._site = site.workers, site
        try:
            self._kernel = parsl.DataFlowKernel(
                parsl.Config(
                    executors=[_executor(site)],
                    retries=site.retries,
                    # In retries: one for a lost worker, more than there are for a job's own error.
                    retry_handler=lambda error, _: 1.0 if _lost(error) else site.retries + 1.0,
                    run_dir=str(self.heartbeat.folder / "parsl"),
                    strategy_period=2.0,
                )
            )
        except Exception as error:  # as which its providers raise what sbatch says differs
            self.heartbeat.close(keep=True)
            raise ConfigError(f"{where}: provider.kind {site.provider.kind}: {error}") from None

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        return self._kernel.submit(
            function, app_args=arguments, executors="all", cache=False, ignore_for_cache=None, app_kwargs={}
        )

    def explain(self, job: Job, error: BaseException) -> BaseException:
        from parsl.executors.errors import BadStateException

        logs = f"logs: {self.heartbeat.folder}"
        if _lost(error):
            return RunError(
                f"{job.name}: lost its worker {self._site.retries + 1} times (the last: {error}); {logs}. "
                "The same command continues; more memory_per_worker or walltime may help"
            )
        return (
            RunError(f"the site gives no workers: {error}; {logs}") if isinstance(error, BadStateException) else error
        )

    def end(self) -> None:
        self._kernel.cleanup()


def _lost(error: BaseException) -> bool:
    from parsl.executors.high_throughput.errors import ManagerLost, WorkerLost

    return isinstance(error, ManagerLost | WorkerLost | worker.WorkerEndedError)


def _executor(site: Site) -> HighThroughputExecutor:
    from parsl.executors import HighThroughputExecutor
    from parsl.executors.high_throughput.executor import DEFAULT_LAUNCH_CMD

    python = site.python or sys.executable
    pool = DEFAULT_LAUNCH_CMD.removeprefix("process_worker_pool.py ")
    return HighThroughputExecutor(
        label="workers",
        provider=provider(site),
        # Their scripts are found without a virtual environment's folder in PATH.
        launch_cmd=f"{python} -m parsl.executors.high_throughput.process_worker_pool {pool}",
        interchange_launch_cmd=[sys.executable, "-m", "experiments.jobs.interchange"],
        address="127.0.0.1" if isinstance(site.provider, Local) else site.address,
        cores_per_worker=float(site.cores_per_worker),
        mem_per_worker=site.memory_per_worker,
        max_workers_per_node=site.workers_per_node,
        cpu_affinity="block" if site.pin else "none",
        available_accelerators=accelerators(site),
        heartbeat_period=HEARTBEAT_PERIOD,
        heartbeat_threshold=HEARTBEAT_TIMEOUT,
    )


def accelerators(site: Site) -> list[str]:
    """Those of each worker of a host, as CUDA_VISIBLE_DEVICES takes them."""
    each = site.accelerators_per_worker
    workers = range(site.workers_per_node if each else 0)
    return [",".join(str(i * each + k) for k in range(each)) for i in workers]


def provider(site: Site) -> ExecutionProvider:
    """Parsl's provider of a site's hosts. Raises what it does where its commands are not here."""
    from parsl.launchers import SingleNodeLauncher, SrunLauncher
    from parsl.providers import LocalProvider, SlurmProvider

    asked = site.provider
    shared: dict[str, Any] = {
        "init_blocks": 1,
        "min_blocks": 0,
        "max_blocks": site.blocks,
        "nodes_per_block": site.nodes_per_block,
        "worker_init": site.worker_init,
    }
    if isinstance(asked, Local):
        return LocalProvider(**shared)
    cpus = f"--cpus-per-task={site.cores}"  # which srun does not take over from sbatch
    return SlurmProvider(
        **shared,
        **asked.model_dump(include={"partition", "account", "qos", "constraint", "exclusive", "walltime"}),
        scheduler_options="\n".join(f"#SBATCH {option}" for option in asked.options),
        cores_per_node=site.cores,
        mem_per_node=math.ceil(site.workers_per_node * site.memory_per_worker),
        gpus_per_node=site.workers_per_node * site.accelerators_per_worker or None,
        launcher=SrunLauncher(overrides=cpus) if site.nodes_per_block > 1 else SingleNodeLauncher(),
        cmd_timeout=60,
    )
