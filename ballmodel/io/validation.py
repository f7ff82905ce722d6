"""Validation of every YAML of the project by its type, and mistakes in the words of the person who wrote the file.

A type is a pydantic model (``Section``), a dataclass or a TypedDict. Its annotations say what is allowed
(``ballmodel.io.ranges.Within`` for numbers); messages are worded from the JSON schema that pydantic makes of it:
    FILE: KEY: expected WHAT, got WHAT; REMEDY
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, create_model
from pydantic_core import ErrorDetails, from_json, to_json

from ballmodel.io import yaml

T = TypeVar("T")
Node = dict[str, Any]  # of a JSON schema

STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
ENDS = {"exclusiveMinimum": "more than", "minimum": "at least", "exclusiveMaximum": "less than", "maximum": "at most"}
MOST_NAMES = 24  # of keys that a message lists
LONGEST = 120  # characters of what was given that are shown

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Decay = Annotated[float, Field(ge=0, lt=1)]
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]  # also that of a folder


def increasing(values: tuple[float, ...]) -> tuple[float, ...]:
    """The numbers, none of which is less than the one before. Raises ValueError."""
    if any(a > b for a, b in zip(values, values[1:], strict=False)):
        raise ValueError("numbers in ascending order")
    return values


Increasing = AfterValidator(increasing)


class Section(BaseModel):
    """A mapping of the YAML: unknown keys are errors, nothing is converted silently."""

    model_config = STRICT | ConfigDict(frozen=True, use_attribute_docstrings=True)

    def to_dict(self) -> dict[str, Any]:
        """Plain data that validates to the same, with every default written out."""
        return self.model_dump(mode="json")


def validate(kind: type[T], data: Any, where: str) -> T:
    """The instance of a type that parsed YAML describes; ``where`` names its origin.

    Raises ValueError with one line per mistake.
    """
    # As JSON, whose lists may be tuples and whose keys are text; nothing else is converted.
    content = to_json({"content": data}, inf_nan_mode="constants", fallback=str)
    make_file: Any = _file
    try:
        return make_file(kind).model_validate_json(content).content
    except ValidationError as error:
        lines = dict.fromkeys(format_errors(error, kind, from_json(content)["content"]))
        raise ValueError("\n".join(f"{where}: {line}" for text in lines for line in text.splitlines())) from None


def read(kind: type[T], path: str | os.PathLike) -> T:
    """The instance of a type that a YAML file describes. Raises ValueError; OSError where it cannot be opened."""
    return validate(kind, yaml.read(path), str(path))


def json_schema(kind: Any) -> dict[str, Any]:
    """JSON schema of a type's files, for editors that complete and check while one types."""
    schema = _schema(kind)
    root, definitions = schema["properties"]["content"], dict(schema.get("$defs", {}))
    if "$ref" in root:
        root = definitions.pop(root["$ref"].removeprefix("#/$defs/"))
    rest = {"$defs": definitions} if definitions else {}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | root | rest


def find(table: Mapping[str, T], name: str, what: str) -> T:
    """The entry of a name. Raises ValueError with the valid names; ``what`` says what they are names of."""
    if name in table:
        return table[name]
    close = difflib.get_close_matches(str(name).lower(), table, 1, cutoff=0.0)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    raise ValueError(f"expected a {what}, {', '.join(table)}, got {name!r}{hint}")


def nearest(name: str, known: Iterable[str]) -> str:
    """The known name that is most like one that is not known, as a question; nothing where none is like it."""
    close = difflib.get_close_matches(str(name), list(known), 1)
    return f"did you mean {close[0]!r}?" if close else ""


@cache
def _file(kind: Any) -> type[BaseModel]:
    """A model of the file, whose strictness holds for dataclasses and TypedDicts in it."""
    return create_model("File", __config__=STRICT, content=(kind, ...))


@cache
def _schema(kind: Any) -> dict[str, Any]:
    return TypeAdapter(_file(kind)).json_schema()


def format_errors(error: ValidationError, kind: Any, data: Any) -> list[str]:
    """One line per mistake: "dotted.path: expected what is allowed, got what was given; what to do"."""
    schema, found = _schema(kind), dict[str, str]()
    for mistake in error.errors(include_url=False):
        path, line = _Place(schema, data, mistake["loc"][1:]).line(mistake)
        found.setdefault(path, line)
    return [
        f"{path}{line}".removeprefix(": ")
        for path, line in found.items()
        # A mapping that fits one member of a union fails as every other one; only the mistake inside it helps.
        if not any(deeper.startswith((f"{path}.", f"{path}[")) for deeper in found)
    ]


class _Place:
    """Where a mistake is: dotted path as it stands in the file, parts of the schema for it and for what holds it."""

    def __init__(self, schema: Node, data: Any, location: tuple[int | str, ...]) -> None:
        self._definitions = schema.get("$defs", {})
        self.path, self.nodes, self.owners = "", list(self._alternatives(schema["properties"]["content"])), []
        for part in location:
            properties = [node.get("properties", {}) for node in self.nodes]
            if isinstance(part, int) and isinstance(data, list):
                self.path += f"[{part}]"
                below = [_entry(node, part) for node in self.nodes if node.get("type") == "array"]
                data = data[part] if part < len(data) else None
            elif isinstance(data, dict) and (part in data or any(part in keys for keys in properties)):
                self.path += f".{part}"
                below = [keys[part] for keys in properties if part in keys]
                below = below or [value for node in self.nodes for value in _values(node)]
                data = data.get(part)
            else:  # pydantic's name of a member of a union, which the writer of the file has never seen
                self.nodes = [node for node in self.nodes if part in _tags(node)] or self.nodes
                continue
            self.owners, self.nodes = self.nodes, [n for node in below for n in self._alternatives(node)]

    def _alternatives(self, node: Any) -> Iterator[Node]:
        """The node, or the members of a union, without references."""
        if not isinstance(node, dict):
            node = {}
        if "$ref" in node:
            node = self._definitions[node["$ref"].removeprefix("#/$defs/")] | {k: node[k] for k in node if k != "$ref"}
        several = node.get("anyOf") or node.get("oneOf")
        for each in several or ():
            yield from self._alternatives(each)
        if not several:
            yield node

    def line(self, mistake: ErrorDetails) -> tuple[str, str]:
        """Path and the rest of the line."""
        kind, given, path = mistake["type"], mistake["input"], self.path.removeprefix(".")
        if kind in ("extra_forbidden", "unexpected_keyword_argument"):
            name = str(mistake["loc"][-1])
            names = list(dict.fromkeys(key for node in self.owners for key in node.get("properties", {})))
            new = next((node["renamed"][name] for node in self.owners if name in node.get("renamed", {})), None)
            hint = f"it is now called {new}" if new else nearest(name, names)
            return path, _formula(f"one of the keys {_list(names)}", f"the unknown key {name!r}", hint)
        if kind.startswith("union_tag"):
            kinds = [node["properties"]["kind"] for node in self.nodes if "kind" in node.get("properties", {})]
            tags = [str(choice) for node in kinds for choice in _choices(node)]
            tag, expected = given.get("kind") if isinstance(given, dict) else None, _either(map(repr, tags))
            hint = nearest(tag, tags) if tag else "it says which kind of mapping this is"
            return f"{path}.kind".removeprefix("."), _formula(expected, repr(tag) if tag else "nothing", hint)
        if kind in ("missing", "missing_argument"):
            return path, _formula(self.expected(), "nothing", "it has no default")
        message = mistake["msg"].removeprefix("Value error, ")
        if kind == "value_error" and not isinstance(given, dict):
            return path, _formula(message, _shown(given))
        if kind == "value_error":  # about several keys, which it names with what was given
            key = re.match(r"(\w+)[.:[]", message)
            within = path and key and any(key[1] in node.get("properties", {}) for node in self.nodes)
            return path, f"{'.' if within else path and ': '}{message}"
        choices = [str(value) for node in self.nodes for value in _choices(node)]
        return path, _formula(self.expected(), _shown(given), nearest(given, choices) if isinstance(given, str) else "")

    def expected(self) -> str:
        """What is allowed here, in words."""
        return _either(dict.fromkeys(self._describe(node) for node in self.nodes))

    def _describe(self, node: Node) -> str:
        if choices := _choices(node):
            return _either(map(repr, choices))
        kind = node.get("type")
        if kind in ("number", "integer"):
            return _number(node, "a number" if kind == "number" else "a whole number")
        if kind == "array":
            items = node.get("prefixItems") or [node.get("items", {})]
            each = (self._describe(node) for item in items for node in self._alternatives(item))
            least, most = node.get("minItems", 0), node.get("maxItems")
            count = f" of {least}" if least == most else f" of at least {least}" if least else ""
            return f"a list{count}, each {_either(dict.fromkeys(each))}"
        if kind == "object":
            names = _list(list(node.get("properties", {})))
            return f"a mapping{names and f' with the keys {names}'}"
        if kind == "string":
            return f"text that matches {node['pattern']}" if "pattern" in node else "text"
        return {"boolean": "true or false", "null": "null"}.get(str(kind), "a value")


def _formula(expected: str, got: str, remedy: str = "") -> str:
    return f": expected {expected}, got {got}{remedy and '; '}{remedy}"


def _list(names: list[str]) -> str:
    more = len(names) - MOST_NAMES
    return ", ".join(names) if more <= 0 else f"{', '.join(names[:MOST_NAMES])} and {more} more"


def _entry(node: Node, index: int) -> Any:
    fixed = node.get("prefixItems", ())
    return fixed[index] if index < len(fixed) else node.get("items", {})


def _values(node: Node) -> list[Any]:
    """Schemas of a mapping's values, whatever their keys."""
    return [value for value in (node.get("additionalProperties"), *node.get("patternProperties", {}).values()) if value]


def _tags(node: Node) -> tuple[Any, ...]:
    """Pydantic's names of a member of a union."""
    return node.get("title"), node.get("properties", {}).get("kind", {}).get("const")


def _choices(node: Node) -> list[Any]:
    return [node["const"]] if "const" in node else node.get("enum", [])


def _number(node: Node, noun: str) -> str:
    unit = f" {node['unit']}" if "unit" in node else ""
    if "minimum" in node and node.get("minimum") == node.get("maximum"):
        return f"{node['minimum']:g}{unit}"
    if "minimum" in node and "maximum" in node:
        return f"{noun} from {node['minimum']:g} to {node['maximum']:g}{unit}"
    ends = " and ".join(f"{word} {node[key]:g}" for key, word in ENDS.items() if key in node)
    return f"{noun} of {ends}{unit}" if ends else noun.replace("a number", "a finite number") + unit


def _either(words: Iterable[str]) -> str:
    """ "a, b or c"."""
    *most, last = list(words) or ["a value"]
    return f"{', '.join(most)} or {last}" if most else last


def _shown(given: Any) -> str:
    """The given value as text, cut where it is long."""
    text = repr(given)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]} ..."
