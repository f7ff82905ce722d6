"""Imports point one way: what each package may import of the others, walked over every source file."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT

PACKAGES = ("robot_io", "ballmodel", "bgs", "mjx_tt", "experiments")

# By the longest matching prefix: modules of the project that a module may import besides those of its own package.
ALLOWED = {
    "robot_io": (),
    "ballmodel": (),
    "bgs": (),
    "mjx_tt": ("ballmodel", "robot_io.contract", "robot_io.limits"),
    "experiments": PACKAGES,
}
JAX = ("jax", "jaxlib", "flax", "optax", "brax", "equinox", "mujoco")
# Of robot_io, whose other modules run on the robot: what some may import besides.
JAX_ALLOWED = {
    "robot_io/policy/export.py": JAX,
    "robot_io/policy/jax_policy.py": ("jax", "jaxlib"),
    "robot_io/emulator/world.py": ("mujoco",),
}


def sources(package):
    return sorted((ROOT / package).rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Dotted names of everything that the file imports, at its top or inside its functions.

    ``from a import b`` may import the module a.b or a name of a; it counts as a.b.
    """
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide where they point"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def within(name: str, prefixes) -> bool:
    return any(name == p or name.startswith(p + ".") for p in prefixes)


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_point_one_way(package):
    assert sources(package), f"no sources in {package}"
    for path in sources(package):
        for name in imported(path):
            if within(name, PACKAGES) and not within(name, (package, *ALLOWED[package])):
                pytest.fail(f"{path.relative_to(ROOT)} imports {name}; {package} may import {ALLOWED[package]}")


def test_the_robots_side_needs_no_jax():
    for path in sources("robot_io"):
        allowed = JAX_ALLOWED.get(path.relative_to(ROOT).as_posix(), ())
        wrong = [name for name in imported(path) if within(name, JAX) and not within(name, allowed)]
        assert not wrong, f"{path.relative_to(ROOT)} imports {wrong}"
    for path in JAX_ALLOWED:
        assert any(within(name, JAX) for name in imported(ROOT / path)), f"the walk finds nothing in {path}"


def test_the_robots_side_loads_without_jax():
    allowed = [path for path, names in JAX_ALLOWED.items() if "jax" in names]
    modules = [module_name(p) for p in sources("robot_io") if p.relative_to(ROOT).as_posix() not in allowed]
    code = f"import sys, {', '.join(modules)}; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def test_there_are_no_import_cycles_between_modules():
    """Of modules as they are imported when the package loads: imports inside functions do not count."""
    modules = {module_name(path): path for package in PACKAGES for path in sources(package)}
    graph = {name: direct(path, modules) - {name} for name, path in modules.items()}
    finished: set[str] = set()

    def visit(name, trail):
        assert name not in trail, " -> ".join([*trail[trail.index(name) :], name])
        if name not in finished:
            for other in sorted(graph[name]):
                visit(other, [*trail, name])
            finished.add(name)

    for name in graph:
        visit(name, [])


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def direct(path: Path, modules) -> set[str]:
    """Modules of the project that the file's top level imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = set()
    for node in tree.body:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {
                f"{node.module}.{alias.name}" if f"{node.module}.{alias.name}" in modules else node.module
                for alias in node.names
            }
    return names & modules.keys()
