"""Mistakes in a site's YAML are refused by file and key; what it asks for reaches Parsl's own providers."""

from __future__ import annotations

import os

import pytest
import yaml

from experiments import cli
from experiments.config import site
from experiments.errors import ConfigError
from experiments.jobs import engines

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
        (
            SLURM | {"worker_per_node": 2},
            r"worker_per_node: expected .*; did you mean 'workers_per_node'\?",
        ),
        (
            SLURM | {"provider": {"kind": "slurn"}},
            r"kind: expected .*'local'.*, got 'slurn'; did you mean 'slurm'",
        ),
        (
            SLURM | {"provider": {"kind": "slurm", "walltime": "90"}},
            r"provider\.walltime: expected hours:minutes:seconds in quotes.*, got '90'",
        ),
        (LOCAL | {"workers_per_node": 4096}, rf"workers_per_node 4096 x cores_per_worker 1: .*at most {CORES}"),
        (LOCAL | {"blocks": 2}, r"blocks 2: .*allowed: 1 with provider\.kind local"),
        ("- slurm", r"a site is a mapping with the keys provider, workers_per_node"),
    ],
)
def test_a_mistake_is_named(tmp_path, data, message):
    path = write(tmp_path, data)
    with pytest.raises(ConfigError, match=message) as error:
        site.load(path)
    assert all("cluster.yaml" in line for line in str(error.value).splitlines())


@pytest.mark.parametrize(
    "arguments, message",
    [
        ("train quickstart.yaml --site nowhere.yaml", "--site nowhere.yaml: cannot be read: No such file or directory"),
        ("train quickstart.yaml --site SITE --processes 2", "--processes 2: with --site"),
        ("train quickstart.yaml --site SITE --distributed auto", "with --distributed each process is started by you"),
        ("is2r ROBOT --site SITE", "with a robot the steps are done where it stands; allowed: local"),
    ],
)
def test_a_command_refuses_what_does_not_go_with_a_site(tmp_path, arguments, message, capsys):
    study = {
        "name": "anna",
        "players": ["player3"],
        "robot": "lockstep",
        "recordings": {"player3": "anna.csv"},
        "ablation": None,
        "simulation": {"rounds": [{"simulated": 1, "real": 1}] * 3},
    }
    (tmp_path / "anna.yaml").write_text(yaml.safe_dump(study))
    places = {"SITE": str(write(tmp_path, SLURM)), "ROBOT": str(tmp_path / "anna.yaml")}
    given = [places.get(part, part) for part in arguments.split()]
    assert cli.main([*given, "--out", str(tmp_path / "runs")]) == 1
    assert message in capsys.readouterr().err


def test_workers_of_a_host_see_accelerators_of_their_own(tmp_path):
    two = site.load(write(tmp_path, SLURM | {"workers_per_node": 2, "accelerators_per_worker": 2}))
    assert engines.accelerators(two) == ["0,1", "2,3"]
    assert engines.accelerators(site.load(write(tmp_path, SLURM))) == []
