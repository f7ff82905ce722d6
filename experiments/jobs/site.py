"""Choice of the engine: by the option --site."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import jax

from experiments.config.site import OWN, Site
from experiments.jobs.engine import Engine, Setup
from experiments.jobs.engines import ParslEngine, PoolEngine


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
