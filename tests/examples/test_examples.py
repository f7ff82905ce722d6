"""Every script of examples/ runs as a newcomer starts it, in a folder of its own, and stays short."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from robot_io.policy import export
from robot_io.policy.policy import Policy
from tests.exam.generator.cases import Case
from tests.exam.generator.write import write
from tests.support.paths import ROOT


@pytest.fixture(scope="module")
def artefact(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policy") / "artefact"
    theta = np.random.default_rng(0).normal(0.0, 0.1, 976)
    export.write(folder, Policy(theta, np.zeros(11), np.ones(11)), {})
    return folder


def run(name: str, folder, *arguments) -> str:
    """Standard output of the example, which finds the package only where it is installed or named."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}
    command = [sys.executable, str(ROOT / "examples" / name), *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_run_policy(artefact, tmp_path):
    lines = run("run_policy.py", tmp_path, artefact).splitlines()
    assert len(lines) == 75 and all("joint_6" in line for line in lines)


@pytest.mark.slow
def test_roll_out(artefact, tmp_path):
    output = run("roll_out.py", tmp_path, artefact)
    assert "returned " in output and "net_clearance" in output
    with Image.open(tmp_path / "landing.png") as picture:
        assert picture.size[0] > 300


@pytest.mark.slow
def test_train_bgs(tmp_path):
    lines = run("train_bgs.py", tmp_path, 3).splitlines()
    assert len(lines) == 3 and "mean return" in lines[-1]
    assert Policy.load(tmp_path / "policy.npz").theta.shape == (976,)


@pytest.mark.slow
def test_step_environment(tmp_path):
    output = run("step_environment.py", tmp_path)
    assert "brax: (256, 88)" in output and "Gymnasium: (64, 88)" in output


@pytest.mark.slow
def test_diagnose_log(tmp_path):
    files, _, _ = write(Case("single", ("table_restitution",), 45.0, "iid", 5, count=200), tmp_path / "case")
    output = run("diagnose_log.py", tmp_path, files[0])
    assert output.splitlines()[0] == "named" and "ball.table.restitution" in output
    assert (tmp_path / "diagnosis" / "report.html").stat().st_size > 10_000
    assert (tmp_path / "diagnosis" / "extended.yaml").exists()
