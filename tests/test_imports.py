"""Imports point one way: between packages, between the rooms of a package and between modules; rooms stay small.

Imports inside functions count as those at the top do; what stands under ``if TYPE_CHECKING:`` does not.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.support.paths import ROOT

PACKAGES = ("robot_io", "ballmodel", "bgs", "mjx_tt", "experiments")

# By the longest matching prefix: modules of the project that a module may import besides those of its own package.
ALLOWED = {
    "robot_io": ("ballmodel.constants", "ballmodel.io"),
    "ballmodel": (),
    "bgs": (),
    "mjx_tt": (
        "ballmodel",
        "robot_io.contract",
        "robot_io.limits",
        "robot_io.policy",
        "robot_io.rally_ends",
        "robot_io.robot_file",
        "robot_io.safety.clearance",
    ),
    "experiments": PACKAGES,
}
JAX = ("jax", "jaxlib", "flax", "optax", "brax", "equinox", "mujoco")
# Of robot_io, whose other modules run on the robot: what some may import besides.
JAX_ALLOWED = {
    "robot_io/policy/export.py": JAX,
    "robot_io/policy/pytree.py": ("jax",),
    "robot_io/policy/jax_policy.py": ("jax", "jaxlib"),
    "robot_io/policy/jax_network.py": ("jax",),
    "robot_io/emulator/world.py": ("mujoco",),
}

# The rooms of each package from the ground up: a module imports from its own room and from rooms further left. A room
# is a folder without the folders in it ("." is the package's own), or a module that stands apart from its folder.
ROOMS = {
    "robot_io": (
        ". devices/egm devices devices/festo safety policy log calibration "
        "control/commissioning control emulator/tracker emulator"
    ),
    "ballmodel": "constants state trajectory io .",
    "bgs": ".",
    "mjx_tt": (
        ". sim robot diagnosis/description diagnosis/robust diagnosis/verdict diagnosis/joint diagnosis/tracks "
        "diagnosis/logs diagnosis/ball/effects diagnosis/ball/flights "
        "diagnosis/ball diagnosis/hits diagnosis/together diagnosis prediction "
        "viz diagnosis/report lanes env gradient rally"
    ),
    "experiments": (
        "errors . config jobs runs view/film view/studio view/programme "
        "evaluation training baselines deploy finetuning study/workflow study/analysis "
        "study/blind study/target_domain study/report study view sharing commands robots cli"
    ),
}
# Module -> module that points up a package's rooms, and goes when it is mended.
POINTS_UP: set[str] = set()
# Modules that import each other, and go when they are mended.
IN_CIRCLES: set[str] = set()
MOST_MODULES = 14
# Folders with more modules, and go when they are mended.
CROWDED: set[str] = set()
MOST_LINES = 400
# Longer modules, each with its reason; those without one go when they are mended.
LONG = {
    "mjx_tt/diagnosis/ball/effects.py": "a table: the catalogue, entry by entry",
    "robot_io/safety/gate.py": "one state machine, whose transitions a safety review reads together",
}


def sources(package):
    return sorted((ROOT / package).rglob("*.py"))


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def import_statements(node: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child
        elif isinstance(child, ast.If) and ast.unparse(child.test).endswith("TYPE_CHECKING"):
            yield from import_statements(ast.Module(child.orelse, []))
        else:
            yield from import_statements(child)


@cache
def imported(path: Path) -> set[str]:
    """Dotted names of everything that the file imports, at its top or inside its functions.

    ``from a import b`` may import the module a.b or a name of a; it counts as a.b.
    """
    names = set()
    for node in import_statements(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        else:
            assert node.level == 0, f"{path}: relative imports hide where they point"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@cache
def arrows() -> dict[str, set[str]]:
    """Modules of the project that each module imports."""
    modules = {module_name(path): path for package in PACKAGES for path in sources(package)}

    def module(name: str) -> str | None:
        return name if name in modules else module(name.rpartition(".")[0]) if name else None

    return {name: {m for m in map(module, imported(path)) if m} - {name} for name, path in modules.items()}


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


def test_the_robots_face_needs_numpy_only():
    """Its import nothing heavy at all; its names neither JAX, MuJoCo, nor what the devices need."""
    others = "jax", "mujoco", "pymodbus", "google", "mcap", "pydantic", "scipy"
    light = (
        "load_artefact",
        "SafetyGate",
        "GateState",
        "SafetyConfig",
        "Policy",
        "StreamingPolicy",
        "LIMITS",
        "RefusedError",
    )
    code = f"""
import sys, robot_io
assert 'numpy' not in sys.modules
{"; ".join(f"robot_io.{name}" for name in light)}
loaded = [m for m in {others} if m in sys.modules]
assert not loaded, loaded
[getattr(robot_io, name) for name in robot_io.__all__]
assert 'jax' not in sys.modules and 'mujoco' not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def room(path: Path) -> str | None:
    """The room of a module in the table of its package; None for the ``__init__`` of a folder with folders in it."""
    package, *parts = path.relative_to(ROOT).with_suffix("").parts
    if parts[-1] == "__init__" and any(folder.glob("*.py") for folder in path.parent.iterdir() if folder.is_dir()):
        return None
    rooms = ROOMS[package].split()
    for name in ("/".join(parts), "/".join(parts[:-1]) or "."):
        if name in rooms:
            return name
    pytest.fail(f"{path.relative_to(ROOT)} is in no room of {package}: {rooms}")


@pytest.mark.parametrize("package", PACKAGES)
def test_rooms_of_a_package_stand_on_each_other(package):
    paths = {module_name(path): path for path in sources(package)}
    rooms, up = ROOMS[package].split(), set()
    for name, others in arrows().items():
        for other in others & paths.keys() if name in paths else ():
            mine, its = room(paths[name]), room(paths[other])
            if mine and its and rooms.index(its) > rooms.index(mine):
                up.add(f"{name} -> {other}")
    assert up == {arrow for arrow in POINTS_UP if arrow.startswith(package + ".")}
    assert {room(path) for path in paths.values()} - {None} == set(rooms), "rooms that nothing stands in"


def test_no_modules_import_each_other():
    """Circles: modules that are reached from themselves."""

    def reached(name: str) -> set[str]:
        found, waiting = set(), [name]
        while waiting:
            new = arrows()[waiting.pop()] - found
            found |= new
            waiting += new
        return found

    assert {name for name in arrows() if name in reached(name)} == IN_CIRCLES


def test_folders_and_modules_stay_small():
    paths = [path for package in PACKAGES for path in sources(package)]
    modules = Counter(path.parent.relative_to(ROOT).as_posix() for path in paths if path.name != "__init__.py")
    assert {folder for folder, count in modules.items() if count > MOST_MODULES} == CROWDED
    lines = {path.relative_to(ROOT).as_posix(): len(path.read_text(encoding="utf-8").splitlines()) for path in paths}
    assert {path for path, count in lines.items() if count > MOST_LINES} == set(LONG)


def test_tests_mirror_the_source():
    """A file of a package's tests is named after the module, or the folder, that it tests; more words may follow."""
    for package in PACKAGES:
        for path in sorted((ROOT / "tests" / package).rglob("test_*.py")):
            folder, words = ROOT / path.relative_to(ROOT / "tests").parent, path.stem.split("_")[1:]
            tested = [folder / "_".join(words[:n]) for n in range(1, len(words) + 1)]
            assert any(t.is_dir() or t.with_suffix(".py").exists() for t in tested), (
                f"{path.relative_to(ROOT)}: of what?"
            )
