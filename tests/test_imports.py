"""Imports point one way, and the robot's side stays light. The contracts are in pyproject.toml."""

from __future__ import annotations

import subprocess
import sys

from importlinter.cli import lint_imports

from tests.support.paths import ROOT

USES_JAX = {f"robot_io/policy/{name}.py" for name in ("export", "jax_policy")}


def test_the_contracts_hold(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert lint_imports() == 0, "run .venv/bin/lint-imports: it names the imports"


def run(code: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)


def test_the_robots_side_loads_without_jax():
    paths = [path.relative_to(ROOT).as_posix() for path in (ROOT / "robot_io").rglob("*.py")]
    modules = [p.removesuffix(".py").removesuffix("/__init__").replace("/", ".") for p in paths if p not in USES_JAX]
    done = run(f"import sys, {', '.join(modules)}; sys.exit('jax' in sys.modules)")
    assert done.returncode == 0, done.stderr


def test_a_policy_needs_numpy_only_and_the_gate_numba():
    """Importing robot_io loads nothing heavy; neither policy nor gate loads JAX or a device's library."""
    others = "jax", "mujoco", "pymodbus", "google", "mcap", "pydantic"
    light = "load_artefact SafetyConfig Policy StreamingPolicy LIMITS RefusedError".split()
    code = f"""
import sys, robot_io
assert 'numpy' not in sys.modules
{"; ".join(f"robot_io.{name}" for name in light)}
loaded = [m for m in {(*others, "numba", "scipy")} if m in sys.modules]
assert not loaded, loaded
robot_io.SafetyGate, robot_io.GateState
loaded = [m for m in {(*others, "scipy.linalg")} if m in sys.modules]  # numba asks scipy for its version
assert not loaded, loaded
[getattr(robot_io, name) for name in robot_io.__all__]
assert 'jax' not in sys.modules and 'mujoco' not in sys.modules
"""
    done = run(code)
    assert done.returncode == 0, done.stderr
