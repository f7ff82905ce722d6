"""The wheel, installed into a folder of its own and used from an empty one."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.support.paths import ROOT

PACKAGES = ("ballmodel", "bgs", "mjx_tt", "robot_io", "experiments")
SMALL = (
    "task.max_steps=60",
    "optimiser.num_directions=2",
    "optimiser.repeats=2",
    "training.updates=3",
    "training.pool=64",
)
SHORT = ("training.max_minutes=null", "training.devices=1", "evaluation.episodes=8", "evaluation.reachable_balls=null")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"  # building leaves files beside the sources
    names = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")
    for name in filter(None, names):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(source)]
    done = subprocess.run(build, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return next(folder.glob("*.whl"))


@pytest.mark.slow
def test_the_wheel_holds_what_the_packages_read_and_nothing_else(wheel):
    found = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert {Path(name).parts[0] for name in found} == set(PACKAGES)
    read = {".yaml", ".xml", ".json", ".html", ".css", ".md", ".pyi", ".typed"}
    ours = subprocess.run(["git", "ls-files", *PACKAGES], cwd=ROOT, capture_output=True, text=True).stdout.split()
    missing = {name for name in ours if Path(name).suffix in read or Path(name).name == "py.typed"} - found
    assert not missing
    assert {f"{package}/py.typed" for package in PACKAGES} <= found


@pytest.mark.slow
def test_installed_a_training_leaves_nothing_but_its_runs(wheel, tmp_path):
    site, home, here = (tmp_path / name for name in ("site", "home", "here"))
    home.mkdir()
    here.mkdir()
    install = [
        "-m",
        "pip",
        "install",
        "-q",
        "--disable-pip-version-check",
        "--no-deps",
        "--target",
        str(site),
        str(wheel),
    ]
    assert subprocess.run([sys.executable, *install]).returncode == 0
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MPL", "XDG", "JAX", "PYTHON"))}
    environment |= {"PYTHONPATH": str(site), "HOME": str(home)}

    def run(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, *arguments], cwd=here, env=environment, capture_output=True, text=True, timeout=1200
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout + done.stderr

    assert run("-c", "import experiments; print(experiments.__path__[0])").strip() == str(site / "experiments")
    changes = [word for change in (*SMALL, *SHORT) for word in ("--set", change)]
    said = run("-m", "experiments.cli", "train", "quickstart.yaml", "--devices", "1", *changes)
    assert [path.name for path in here.iterdir()] == ["runs"]
    assert (here / "runs" / "quickstart" / "artefact" / "manifest.json").exists()
    for noise in ("warp", "slow compile", "WARNING", "Warning", "absl"):
        assert noise not in said, said
