"""The engine for other hosts: Parsl's high-throughput executor on a site's blocks of workers."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterable
from concurrent.futures import Future
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.config.site import Local, Pbs, Site, Slurm
from experiments.errors import ConfigError, RunError
from experiments.jobs import remote
from experiments.jobs.engine import Job, Setup
from experiments.jobs.signs import Owner

if TYPE_CHECKING:
    from parsl.executors import HighThroughputExecutor
    from parsl.providers.base import ExecutionProvider

SIGNS = ".jobs"  # folder of the signs and of Parsl's logs, in that of the results
HEARTBEAT = 5  # [s] between looks of a host at its workers, and between signs that it lives
LOST = 60  # [s] without a sign after which a host is given up, or gives itself back
SAVING = 600.0  # [s] for jobs to save when they are asked to stop: a compilation comes first


class ParslEngine:
    """Workers of a site; ``folder`` is that of the results, which all hosts see at the same path.

    Raises ConfigError where the site's commands or its cluster are not here.
    """

    def __init__(self, setup: Setup, site: Site, where: str, folder: Path) -> None:
        import parsl

        self.slots, self._site = site.workers, site
        self._signs = Owner(folder.absolute() / SIGNS)
        self._failed = False
        self._session = remote.Session(setup, str(self._signs.folder), str(Path.cwd()))
        try:
            self._kernel = parsl.DataFlowKernel(
                parsl.Config(
                    executors=[_executor(site)],
                    retries=site.retries,
                    retry_handler=self._cost,
                    run_dir=str(self._signs.folder / "parsl"),
                    strategy_period=2.0,
                )
            )
        except Exception as error:  # as which its providers raise what kubectl, sbatch or qsub say differs
            self._signs.close(keep=True)
            raise ConfigError(f"{where}: provider.kind {site.provider.kind}: {error}") from None

    def submit(self, job: Job) -> Future[Any]:
        """As ``JobEngine``."""
        inner = self._kernel.submit(
            remote.work,
            app_args=(self._session, job.name, job.arguments),
            executors="all",
            cache=False,
            ignore_for_cache=None,
            app_kwargs={},
        )
        result: Future[Any] = Future()

        def settle(done: Future[Any]) -> None:
            error = done.exception()
            if error is None:
                result.set_result(done.result())
            else:
                self._failed = True
                result.set_exception(self._explained(job, error))

        inner.add_done_callback(settle)
        return result

    def check(self) -> None:
        """As ``JobEngine``."""
        if self._signs.asked_to_stop():
            raise KeyboardInterrupt

    def stop(self, running: Iterable[Future[Any]], at_once: bool) -> None:
        """As ``JobEngine``; jobs that no worker has begun are not waited for."""
        self._signs.stop()
        until = time.monotonic() + SAVING
        while not at_once and time.monotonic() < until and self._signs.busy():
            if all(future.done() for future in running):
                return
            time.sleep(0.2)
        time.sleep(0.0 if at_once else 1.0)  # results under way

    def close(self) -> None:
        """As ``JobEngine``: gives the hosts back."""
        self._kernel.cleanup()
        self._signs.close(keep=self._failed)

    def _cost(self, error: Exception, _record: Any) -> float:
        """Of a failure, in retries: one for a lost worker, more than there are for a job's own error."""
        return 1.0 if _lost(error) else self._site.retries + 1.0

    def _explained(self, job: Job, error: BaseException) -> BaseException:
        if _lost(error):
            return RunError(
                f"{job.name}: lost its worker {self._site.retries + 1} times (the last: {error}); logs: "
                f"{self._signs.folder}. The same command continues; more memory_per_worker or walltime may help"
            )
        from parsl.executors.errors import BadStateException

        if isinstance(error, BadStateException):
            return RunError(f"the site gives no workers: {error}; logs: {self._signs.folder}")
        return error


def _lost(error: BaseException) -> bool:
    from parsl.executors.high_throughput.errors import ManagerLost, WorkerLost

    return isinstance(error, ManagerLost | WorkerLost | remote.WorkerEndedError)


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
        heartbeat_period=HEARTBEAT,
        heartbeat_threshold=LOST,
    )


def accelerators(site: Site) -> list[str]:
    """Those of each worker of a host, as CUDA_VISIBLE_DEVICES takes them."""
    each = site.accelerators_per_worker
    if not each:
        return []
    return [",".join(str(i * each + k) for k in range(each)) for i in range(site.workers_per_node)]


def provider(site: Site) -> ExecutionProvider:
    """Parsl's provider of a site's hosts. Raises what it does where its commands or its cluster are not here."""
    from parsl import providers
    from parsl.launchers import SingleNodeLauncher, SrunLauncher

    asked = site.provider
    memory = math.ceil(site.workers_per_node * site.memory_per_worker)
    gpus = site.workers_per_node * site.accelerators_per_worker
    cpus = f"--cpus-per-task={site.cores}"  # which srun does not take over from sbatch
    shared: dict[str, Any] = {
        "init_blocks": 1,
        "min_blocks": 0,
        "max_blocks": site.blocks,
        "nodes_per_block": site.nodes_per_block,
        "worker_init": site.worker_init,
    }
    if isinstance(asked, Local):
        return providers.LocalProvider(**shared)
    if isinstance(asked, Slurm):
        return providers.SlurmProvider(
            **shared,
            partition=asked.partition,
            account=asked.account,
            qos=asked.qos,
            constraint=asked.constraint,
            exclusive=asked.exclusive,
            walltime=asked.walltime,
            scheduler_options="\n".join(f"#SBATCH {option}" for option in asked.options),
            cores_per_node=site.cores,
            mem_per_node=memory,
            gpus_per_node=gpus or None,
            launcher=SrunLauncher(overrides=cpus) if site.nodes_per_block > 1 else SingleNodeLauncher(),
            cmd_timeout=60,
        )
    if isinstance(asked, Pbs):
        chunk = [f"mem={memory}gb", *([asked.select] if asked.select else [])]
        return providers.PBSProProvider(
            **shared,
            queue=asked.queue,
            account=asked.account,
            walltime=asked.walltime,
            select_options=":".join(chunk),
            scheduler_options="\n".join(f"#PBS {option}" for option in asked.options),
            cpus_per_node=site.cores,
        )
    limits = {asked.accelerator: str(gpus)} if gpus else {}
    return providers.KubernetesProvider(
        **shared,
        image=asked.image,
        namespace=asked.namespace,
        max_cpu=float(site.cores),
        init_cpu=float(site.cores),
        max_mem=f"{memory}Gi",
        init_mem=f"{memory}Gi",
        extra_limits=limits,
        extra_requests=limits,
        persistent_volumes=list(asked.volumes.items()),
        service_account_name=asked.service_account,
        secret=asked.secret,
        user_id=None if asked.user is None else str(asked.user),
        group_id=None if asked.group is None else str(asked.group),
    )
