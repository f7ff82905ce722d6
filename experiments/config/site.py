"""The typed YAML of a site: where jobs run, what each worker gets, how workers are asked for.

Needs neither JAX nor NumPy nor Parsl, as ``experiments.config.experiment``. Keys of providers are those of Parsl's
providers of the same name (Babuji et al. 2019, "Parsl: Pervasive Parallel Programming in Python"), in our units.
"""

from __future__ import annotations

import os
import re
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, field_validator, model_validator

from ballmodel.io.validation import Count, Positive, Section
from experiments.config import files


def _walltime(value: Any) -> Any:
    """YAML reads 08:00:00 without quotes as 28800, and SLURM reads shorter forms as minutes."""
    if not isinstance(value, str) or not re.fullmatch(r"\d{1,3}:[0-5]\d:[0-5]\d", value):
        raise ValueError('hours:minutes:seconds in quotes, such as "08:00:00"')
    return value


Walltime = Annotated[str, BeforeValidator(_walltime)]
BatchOption = Annotated[str, Field(pattern=r"^[^\n]+$")]
OWN = "local"  # the name of the process pool, which needs no file


class Local(Section):
    """This machine."""

    kind: Literal["local"]
    """Parsl's LocalProvider."""


class Slurm(Section):
    """A SLURM cluster."""

    kind: Literal["slurm"]
    """Parsl's SlurmProvider."""
    walltime: Walltime
    """Longest time of a block as "HH:MM:SS"; a job that it cuts goes on in the next block from its checkpoint."""
    nodes_per_block: Count = 1
    """Hosts of a block: of what is asked for at once."""
    partition: str | None = None
    """Partition; null: the cluster's default, as for the next three."""
    account: str | None = None
    """Account that is charged."""
    qos: str | None = None
    """Quality of service."""
    constraint: str | None = None
    """Features that nodes need, such as one kind of processor."""
    exclusive: bool = False
    """Nodes that no other job shares."""
    options: list[BatchOption] = []
    """Further options of sbatch, such as --nice=100."""


Provider = Annotated[Local | Slurm, Field(discriminator="kind")]


class Site(Section):
    """One site."""

    provider: Provider
    """Hosts, by how they are asked for."""
    workers_per_node: Count
    """Jobs at a time on a host."""
    cores_per_worker: Count = 1
    """Processor cores of a worker; also the host devices that a training with devices: auto takes."""
    pin: bool = True
    """Every worker keeps to cores of its own."""
    accelerators_per_worker: Annotated[int, Field(ge=0)] = 0
    """Accelerators of a worker, which sees no others; 0: processors only."""
    memory_per_worker: Positive = 2.0
    """[GB] asked for, per worker; a host runs as many workers as it has memory for."""
    blocks: Count = 1
    """Blocks at most, which are asked for as jobs are waiting; a block is one host unless the provider says more."""
    worker_init: str = ""
    """Shell lines before a worker starts, such as module load or source .../bin/activate."""
    python: str | None = None
    """Interpreter on the hosts; null: the path of the one here."""
    address: str | None = None
    """Address of this machine at which hosts reach it; null: they try all that it has."""
    cache: str | None = None
    """Folder of compiled programs, seen by all hosts; null: the one here."""
    retries: Annotated[int, Field(ge=0)] = 3
    """Times that a job begins again, from its checkpoint, after its worker was lost."""

    @field_validator("worker_init")
    @classmethod
    def _lines(cls, value: str) -> str:
        return value.rstrip("\n")

    @model_validator(mode="after")
    def _possible(self) -> Site:
        here = len(os.sched_getaffinity(0))
        if isinstance(self.provider, Local) and self.cores > here:
            raise ValueError(
                f"workers_per_node {self.workers_per_node} x cores_per_worker {self.cores_per_worker}: this machine "
                f"has {here} cores for this program; allowed: a product of at most {here}"
            )
        if isinstance(self.provider, Local) and self.blocks > 1:
            raise ValueError(f"blocks {self.blocks}: this machine is one block; allowed: 1 with provider.kind local")
        return self

    @property
    def cores(self) -> int:
        """Of a host."""
        return self.workers_per_node * self.cores_per_worker

    @property
    def workers(self) -> int:
        """Of the whole site, when all its blocks are there."""
        return self.blocks * self.nodes_per_block * self.workers_per_node

    @property
    def nodes_per_block(self) -> int:
        """Hosts of a block."""
        return self.provider.nodes_per_block if isinstance(self.provider, Slurm) else 1


def load(path: str | os.PathLike) -> Site:
    """Reads a site. Raises ConfigError with one line per mistake."""
    data = files.read_mapping(path, lambda: f"--site takes {OWN}, or a site's YAML")
    return files.validate(Site, data, str(path))
