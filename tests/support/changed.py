"""The test files that a change can affect, one a line: ``python -m tests.support.changed [BASE]``.

A test file is affected when it, or a module that it imports directly or through others, differs from the commit BASE
(without it, from the last commit). Other files of a package, such as YAMLs and templates, count as their folder's
modules; what lies outside of the packages and tests, such as pyproject.toml, affects all tests. Tests of a changed
module's own folder always count.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import grimp

PACKAGES = ("robot_io", "ballmodel", "bgs", "mjx_tt", "experiments")
OUTSIDE = ("docs", "README.md", ".github")  # of the packages: tested by tests/test_docs.py


def list_changed_files(base: str) -> list[Path]:
    """Paths that differ from the commit ``base``, with those that git does not track yet."""
    commands = ["git", "diff", "--name-only", base], ["git", "ls-files", "--others", "--exclude-standard"]
    return [Path(line) for c in commands for line in subprocess.check_output(c, text=True).splitlines()]


def find_imports(test: Path) -> set[str]:
    """Dotted names that a file imports anywhere; ``from a import b`` counts as a.b."""
    names = set()
    for node in ast.walk(ast.parse(test.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def select_tests(changed: list[Path]) -> list[Path]:
    """The affected files among tests/**/test_*.py."""
    graph = grimp.build_graph(*PACKAGES, exclude_type_checking_imports=True)
    every = sorted(Path("tests").rglob("test_*.py"))
    modules: set[str] = set()
    for path in changed:
        name = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
        if path.parts[0] in PACKAGES:
            folder = ".".join(path.parts[:-1])
            modules.add(f"tests.{folder}")  # programs that tests start in processes of their own are in no graph
            found = {name} if path.suffix == ".py" else {m for m in graph.modules if f"{m}.".startswith(f"{folder}.")}
            modules |= found
            for module in found & graph.modules:
                modules |= graph.find_downstream_modules(module)
        elif path.parts[0] == "tests" and path.name.startswith("test_"):
            modules.add(name)
        elif path.parts[0] == "tests" and path.parts[1] != "conftest.py":
            folder = ".".join(path.parts[:-1])
            modules.add(name)
            modules |= {m for t in every if (m := ".".join(t.with_suffix("").parts)).startswith(f"{folder}.")}
        elif path.parts[0] not in OUTSIDE:
            return every

    def is_affected(test: Path) -> bool:
        if not modules.isdisjoint({".".join(test.with_suffix("").parts), ".".join(test.parent.parts)}):
            return True
        return any(name in modules or name.rpartition(".")[0] in modules for name in find_imports(test))

    return [test for test in every if is_affected(test)]


if __name__ == "__main__":
    print(*select_tests(list_changed_files(sys.argv[1] if len(sys.argv) > 1 else "HEAD")), sep="\n")
