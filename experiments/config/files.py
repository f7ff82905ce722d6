"""The way from a YAML file to a validated section: overrides, relative paths, and hints at the file that was meant."""

from __future__ import annotations

import difflib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from ballmodel.io import validation, yaml
from experiments.errors import ConfigError, error_context

T = TypeVar("T")

SHIPPED = Path(__file__).parents[1] / "shipped"  # train/, study/, compare/: YAMLs that come with the program
KINDS = {  # of YAML: the command that takes it, the key by which it is known, its folder of SHIPPED
    "an experiment": ("train", "balls", "train"),
    "a study": ("is2r", "simulation", "study"),
    "a comparison": ("compare", "algorithms", "compare"),
}


def validate(kind: type[T], data: Any, where: str) -> T:
    """The section in parsed YAML; ``where`` names its origin. Raises ConfigError with one line per mistake."""
    with error_context():
        return validation.validate(kind, data, where)


def load(
    kind: type[T],
    what: str,
    path: str | os.PathLike,
    overrides: tuple[str, ...],
    make_absolute: Callable[[dict[str, Any], Path], None],
) -> T:
    """Reads a section, changed by ``overrides``, "dotted.path=value" with the value in YAML. Raises ConfigError.

    Args:
        kind: The section.
        what: The kind of YAML, a key of KINDS.
        path: The file.
        overrides: Changes of the file's content.
        make_absolute: Makes relative paths in the data absolute, given the folder to which they are relative: the
            file's, and the current one for overrides.
    """
    path = Path(path)
    data = read_mapping(path, hint=lambda: _guess_file(path, what))
    make_absolute(data, path.parent)
    for override in overrides:
        apply_override(data, override)
    make_absolute(data, Path.cwd())
    other = None if KINDS[what][1] in data else _find_kind(data)
    if other is not None:
        command, key, _ = KINDS[other]
        raise ConfigError(f"{path}: expected {what}, got {other} with the key {key}; use `mjx-tt {command} {path}`")
    return validate(kind, data, str(path))


def read_mapping(path: str | os.PathLike, hint: Callable[[], str] = str) -> dict[str, Any]:
    """The mapping in a YAML file, {} where it is empty; ``hint`` says what to do where it cannot be read.

    Raises ConfigError.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        remedy = hint()
        raise ConfigError(f"{path}: cannot be read: {error}{remedy and '; '}{remedy}") from None
    data = read_yaml(text, str(path))
    if data is not None and not isinstance(data, dict):
        raise ConfigError(f"{path}: expected a mapping, got {data!r}"[:300])
    return data or {}


def read_yaml(text: str, where: str) -> Any:
    """Parsed YAML. Raises ConfigError naming ``where`` and the line."""
    with error_context():
        return yaml.parse(text, where)


def apply_override(data: dict[str, Any], override: str) -> None:
    """Sets one value of parsed YAML, given as "dotted.path=value" with a YAML value. Raises ConfigError."""
    path, sign, value = override.partition("=")
    if not sign or not all(path.split(".")):
        raise ConfigError(f"--set {override}: expected dotted.path=value, such as training.updates=500")
    *parents, leaf = path.split(".")
    for parent in parents:
        data = data.setdefault(parent, {})
        if not isinstance(data, dict):
            raise ConfigError(f"--set {override}: {parent}: expected a mapping, got {data!r}")
    data[leaf] = read_yaml(value, f"--set {override}")


def make_absolute(data: Any, keys: tuple[str, ...], folder: Path) -> None:
    """Makes paths under these keys of a mapping absolute that are relative to ``folder``; other values stay."""
    for key in keys if isinstance(data, dict) else ():
        if isinstance(data.get(key), str):
            data[key] = str((folder / data[key]).resolve())


def shipped(folder: str) -> dict[str, Path]:
    """The YAMLs of a folder of SHIPPED, by name."""
    return {path.stem: path for path in sorted((SHIPPED / folder).glob("*.yaml"))}


def find_shipped(name: str, folder: str) -> Path:
    """The file of that name, or the one of that name in a folder of SHIPPED."""
    path = Path(name)
    return path if path.exists() or path.parent != Path() else shipped(folder).get(path.stem, path)


def _find_kind(data: dict[str, Any]) -> str | None:
    """Kind of YAML that its keys point to; None where they do not tell."""
    return next((kind for kind, (_, key, _) in KINDS.items() if key in data), None)


def _guess_file(path: Path, what: str) -> str:
    """Guess at the file meant by one that is not there: one of another command, one nearly of that name."""
    known = shipped(KINDS[what][2])
    twin = next(SHIPPED.glob(f"*/{path.stem}.yaml"), None)
    if path.stem not in known and twin:
        other = _find_kind(read_mapping(twin))
        if other not in (None, what):
            command = KINDS[str(other)][0]
            return f"expected {what}, the shipped {twin.name} is {other}: use `mjx-tt {command} {twin.name}`"
    near = difflib.get_close_matches(path.stem, known, 1)
    return f"did you mean {near[0]}.yaml?" if near else f"shipped are {', '.join(known)}"
