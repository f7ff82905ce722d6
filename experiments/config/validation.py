"""Mistakes that pydantic found in a mapping, in the words of the person who wrote it."""

from __future__ import annotations

import difflib
import re
import types
from collections.abc import Iterable
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from experiments.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)

LONGEST = 120  # characters of what was given that are shown
RENAMED = {"pairs": "num_directions", "keep": "elite_fraction", "average": "ema_decay"}  # keys of the optimiser


def validated(model: type[Model], data: dict[str, Any], where: str) -> Model:
    """The model of parsed YAML; ``where`` names its origin. Raises ConfigError with one line per mistake."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError("\n".join(f"{where}: {line}" for line in lines(error, model))) from None


def lines(error: ValidationError, model: type[BaseModel]) -> list[str]:
    """One line per mistake: "dotted.path: what was given, what is allowed, the nearest valid name".

    A mistake that concerns the whole file has no path; its text names the keys.
    """
    found: dict[str, tuple[str, list[str]]] = {}  # path -> beginning of the line, what is allowed there
    for mistake in error.errors():
        path, owner = _walk(mistake, model)
        beginning, allowed = _describe(mistake, path, owner)
        found.setdefault(path, (beginning, []))[1].append(allowed)
    return [
        f"{path and f'{path}: '}{beginning}{' or '.join(allowed)}"
        for path, (beginning, allowed) in found.items()
        # A mapping that fits one member of a union fails as every other one; only the mistake inside it helps.
        if not any(deeper.startswith(f"{path}.") for deeper in found)
    ]


def nearest(name: str, known: Iterable[str]) -> str:
    """ "did you mean 'x'? " or nothing."""
    close = difflib.get_close_matches(name, list(known), 1)
    return f"did you mean {close[0]!r}? " if close else ""


def _describe(mistake: ErrorDetails, path: str, owner: type[BaseModel]) -> tuple[str, str]:
    kind, given = mistake["type"], mistake["input"]
    if kind == "extra_forbidden":
        parent, _, name = path.rpartition(".")
        names = list(owner.model_fields)
        if RENAMED.get(name) in names:
            return "now called ", RENAMED[name]
        unknown = "unknown key" if path else "unknown key ''"  # which leaves nothing to begin the line with
        return f"{unknown}; {nearest(name, names)}allowed{f' in {parent}' if parent else ''}: ", ", ".join(names)
    if kind == "missing":
        return "missing, it has no default", ""
    if kind == "union_tag_not_found":
        return "missing, it says which kind of mapping this is", ""
    if kind == "union_tag_invalid":
        tags = mistake["ctx"]["expected_tags"]
        return f"got {given['kind']!r}; {nearest(given['kind'], re.findall(r'[a-z_]+', tags))}allowed: ", tags
    if kind == "literal_error":
        options = mistake["ctx"]["expected"]
        return f"got {_shown(given)}; {nearest(str(given), re.findall(r'[a-z_]+', options))}allowed: ", options
    if kind in ("model_type", "dict_type"):
        return f"got {_shown(given)}; allowed: ", "a mapping"
    message = mistake["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    if kind == "value_error" and isinstance(given, dict):
        return "", message  # about several keys, which it names with what was given
    return f"got {_shown(given)}; allowed: ", message


def _shown(given: Any) -> str:
    """The given value as text, cut where it is long."""
    text = repr(given)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]} ..."


def _walk(mistake: ErrorDetails, model: type[BaseModel]) -> tuple[str, type[BaseModel]]:
    """The dotted path as it stands in the file, and the model whose key it ends with.

    Pydantic's location also holds names of union members, which the writer of the file has never seen.
    """
    path, owner, candidates = "", model, [model]
    for part in mistake["loc"]:
        sections = [c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)]
        holder = next((s for s in sections if part in s.model_fields), None)
        member = next((s for s in sections if part in _tags(s)), None)
        if isinstance(part, int):
            path += f"[{part}]"
        elif len(candidates) == 1 and get_origin(candidates[0]) is dict:
            path, candidates = f"{path}.{part}", _members(get_args(candidates[0])[1])
        elif len(candidates) > 1 and member:
            candidates = [member]
        elif holder:
            path, owner = f"{path}.{part}", holder
            candidates = _members(holder.model_fields[part].annotation)
        elif len(candidates) == 1 and sections and sections[0].model_config.get("extra") == "allow":
            path, candidates = f"{path}.{part}", []
        elif mistake["type"] == "extra_forbidden" and sections:
            path, owner = f"{path}.{part}", sections[0]
    if mistake["type"].startswith("union_tag"):
        path += ".kind"
    return path.removeprefix("."), owner


def _members(annotation: Any) -> list[Any]:
    """The types that a field may have; a list counts as its items."""
    origin = get_origin(annotation)
    if origin is Annotated or origin is list:
        return _members(get_args(annotation)[0])
    if origin in (Union, types.UnionType):
        return [member for argument in get_args(annotation) for member in _members(argument)]
    return [annotation]


def _tags(section: type[BaseModel]) -> set[str]:
    """Pydantic's names of this member of a union."""
    kind = section.model_fields.get("kind")
    return {section.__name__, *(get_args(kind.annotation) if kind else ())}
