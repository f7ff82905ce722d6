"""Mistakes in a site's YAML are refused by file and key; what it asks for reaches Parsl's own providers."""

from __future__ import annotations

import os

import pytest
import yaml

from experiments.config import site
from experiments.errors import ConfigError
from experiments.jobs.site import accelerators

CORES = len(os.sched_getaffinity(0))
SLURM = {"provider": {"kind": "slurm", "walltime": "01:30:00"}, "workers_per_node": 16}
LOCAL = {"provider": {"kind": "local"}, "workers_per_node": 1}


def write(folder, data):
    path = folder / "cluster.yaml"
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data))
    return path


@pytest.mark.parametrize(
    "data, message",
    [
        (SLURM | {"worker_per_node": 2}, r"worker_per_node: expected .*; did you mean 'workers_per_node'\?"),
        (SLURM | {"provider": {"kind": "slurn"}}, r"kind: expected .*'local'.*, got 'slurn'; did you mean 'slurm'"),
        (
            SLURM | {"provider": {"kind": "slurm", "walltime": "90"}},
            r"provider\.walltime: expected hours:minutes:seconds in quotes.*, got '90'",
        ),
        (LOCAL | {"workers_per_node": 4096}, rf"workers_per_node 4096 x cores_per_worker 1: .*at most {CORES}"),
        (LOCAL | {"blocks": 2}, r"blocks 2: .*allowed: 1 with provider\.kind local"),
        ("- slurm", r"cluster.yaml: expected a mapping, got \['slurm'\]"),
    ],
)
def test_a_mistake_is_named(tmp_path, data, message):
    path = write(tmp_path, data)
    with pytest.raises(ConfigError, match=message) as error:
        site.load(path)
    assert all("cluster.yaml" in line for line in str(error.value).splitlines())


def test_workers_of_a_host_see_accelerators_of_their_own(tmp_path):
    two = site.load(write(tmp_path, SLURM | {"workers_per_node": 2, "accelerators_per_worker": 2}))
    assert accelerators(two) == ["0,1", "2,3"]
    assert accelerators(site.load(write(tmp_path, SLURM))) == []
