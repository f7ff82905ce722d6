"""Sphinx extension: writes the reference pages that follow from the source, before every build.

Configuration keys and the verdict come from JSON schemas, the command line from its parser, the Python API from the
packages' public names. All pages land in ``docs/reference/generated/``; a page is written only when its text changes,
so that an incremental build reads nothing twice.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fnmatch
import importlib
import inspect
import io
import json
import re
import textwrap
import types
import typing
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from docstring_parser.google import parse as parse_google

if TYPE_CHECKING:
    from sphinx.application import Sphinx

REFERENCE = Path(__file__).resolve().parents[1] / "reference"
GENERATED = REFERENCE / "generated"
PACKAGES = ("robot_io", "ballmodel", "bgs", "mjx_tt")  # a name that several show is described with the first


def setup(app: Sphinx) -> dict[str, Any]:
    """Entry point of the extension."""
    app.connect("builder-inited", lambda app: write_all())
    app.connect("autodoc-process-docstring", _complete, priority=400)  # before Napoleon
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _complete(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Adds the notes beside a dataclass's fields to its docstring."""
    lines[:] = google("\n".join(lines)).splitlines()
    if what == "class" and dataclasses.is_dataclass(value):
        told = {name for parameter in parse_google("\n".join(lines)).params for name in parameter.arg_name.split(", ")}
        notes = {field: note for field, note in field_notes(value)[1].items() if field not in told}
        if notes:
            escaped = {field: re.sub(r"([*|])", r"\\\1", note) for field, note in notes.items()}
            lines += ["", "Attributes:", *(f"    {field}: {note}" for field, note in escaped.items()), ""]


def google(docstring: str) -> str:
    """Docstring with rows "name   meaning" in columns as a Google section; any other text stays as it is."""
    blocks = docstring.split("\n\n")
    for i, block in enumerate(blocks):
        rows = textwrap.dedent(block).splitlines()
        columns = [re.match(r"([a-z][\w.*]*(?:, [a-z][\w.*]*)*) {2,}(\S.*)$", row) for row in rows]
        if (
            rows
            and columns[0]
            and all(column or row.startswith("  ") for column, row in zip(columns, rows, strict=True))
        ):
            text = [
                f"    {c[1]}: {c[2]}" if c else f"        {row.strip()}" for c, row in zip(columns, rows, strict=True)
            ]
            blocks[i] = "\n".join(["Attributes:", *text])
    return "\n\n".join(blocks)


def field_notes(kind: type) -> tuple[str, dict[str, str]]:
    """Summary of a dataclass, and what its docstring and the comments beside its fields say of each field."""
    docstring, source = google(inspect.getdoc(kind) or ""), inspect.getsource(kind)
    notes = {name: text for text, name in re.findall(r"^    # (.+)\n    (\w+): ", source, re.MULTILINE)}
    notes |= dict(re.findall(r"^    (\w+): .*?  # (.+)$", source, re.MULTILINE))
    for parameter in parse_google(docstring).params:
        for field in dataclasses.fields(kind):
            if any(fnmatch.fnmatch(field.name, name) for name in parameter.arg_name.split(", ")):
                notes[field.name] = parameter.description or ""
    return docstring.split("\n\n")[0], notes


def write_all() -> None:
    """Write every generated page."""
    from ballmodel.io import validation
    from experiments.config import baselines, experiment, site, study
    from experiments.config.finetuning import FineTuning
    from experiments.config.robot import COMMISSIONING
    from robot_io.control.config import RobotConfig
    from robot_io.emulator.config import RigParams

    GENERATED.mkdir(parents=True, exist_ok=True)
    known: dict[str, Section] = {}  # sections that several files share are described once
    _write("experiment", schema_page("Experiment", "mjx-tt train", validation.json_schema(experiment.Config), known))
    _write("fine-tuning", schema_page("Fine-tuning", "mjx-tt finetune", FineTuning.model_json_schema(), known))
    _write("study", schema_page("Study", "mjx-tt is2r", study.Study.model_json_schema(), known))
    _write("comparison", schema_page("Comparison", "mjx-tt compare", baselines.Comparison.model_json_schema(), known))
    _write("site", schema_page("Site", "--site", site.Site.model_json_schema(), known))
    verdict = json.loads((REFERENCE / "verdict.schema.json").read_text("utf-8"))
    _write("verdict", schema_page("Verdict", "", verdict, {}))
    _write("model", model_page())
    slow = f"Without `safety.speed_scale` a robot moves at {COMMISSIONING:.0%} of its speed."
    robot = dataclass_schema(RobotConfig)
    _write("robot", schema_page("robot.yaml", "mjx-tt run` and `mjx-tt finetune", robot, {}, slow))
    _write("rig", schema_page("rig.yaml", "mjx-tt run --robot rig --rig", dataclass_schema(RigParams), {}))
    _write("command-line", command_line_page())
    described: dict[int, str] = {}
    for package in PACKAGES:
        _write(f"api-{package}", api_page(package, described))


class Section(NamedTuple):
    """A section of a schema that a page describes."""

    anchor: str
    definition: dict[str, Any]


def schema_page(title: str, command: str, schema: dict[str, Any], known: dict[str, Section], remark: str = "") -> str:
    """Page with one table per section of a JSON schema, except those that ``known`` holds; they are added to it."""
    page = title.lower().removesuffix(".yaml")
    definitions = schema.get("$defs", {})
    own = [name for name in _in_order(schema, definitions) if definitions[name].get("properties")]
    own = [name for name in own if name not in known or known[name].definition != definitions[name]]
    known |= {name: Section(f"{page}-{name.lower()}", definitions[name]) for name in own}
    anchors = {name: section.anchor for name, section in known.items()}
    lines = [f"({page}-yaml)=", f"# {title}", ""]
    if command:
        lines += [f"The YAML of `{command}`. Keys without a default are required. {remark}".rstrip(), ""]
    else:
        lines += [schema.get("description", ""), ""]
    lines += _table(schema, definitions, anchors)
    for name in own:
        section = definitions[name]
        lines += ["", f"({anchors[name]})=", f"## {name}", "", _cell(section.get("description", "")), ""]
        lines += _table(section, definitions, anchors)
    root = {key: value for key, value in schema.items() if key != "$defs"}
    known.setdefault(schema.get("title", title), Section(f"{page}-yaml", root))
    return "\n".join(lines) + "\n"


def _in_order(schema: dict[str, Any], definitions: dict[str, Any]) -> list[str]:
    """Names of the definitions in the order in which the schema refers to them, depth first."""
    found: list[str] = []

    def visit(node: Any) -> None:
        if isinstance(node, dict):
            name = node.get("$ref", "").removeprefix("#/$defs/")
            if name and name not in found:
                found.append(name)
                visit(definitions[name])
            for key, value in node.items():
                if key not in ("$defs", "default", "discriminator"):
                    visit(value)
        elif isinstance(node, list):
            for value in node:
                visit(value)

    visit(schema)
    return found


def _table(section: dict[str, Any], definitions: dict[str, Any], anchors: dict[str, str]) -> list[str]:
    required = section.get("required", [])
    with_default = any("default" in key for key in section["properties"].values())
    rows = ["| key | allowed |" + (" default |" if with_default else "") + " meaning |"]
    rows.append("|---|---|" + ("---|" if with_default else "") + "---|")
    for name, key in section["properties"].items():
        allowed = _type(key, definitions, anchors)
        default = _default(key, definitions) if name not in required else "required"
        meaning = _cell(key.get("description") or _section(key, definitions).get("description", ""))
        rows.append(f"| `{name}` | {allowed} |" + (f" {default} |" if with_default else "") + f" {meaning} |")
    return rows


def _type(key: dict[str, Any], definitions: dict[str, Any], anchors: dict[str, str]) -> str:
    """Allowed values of a key, in words."""
    if "$ref" in key:
        name = key["$ref"].removeprefix("#/$defs/")
        return f"[{name}](#{anchors[name]})" if name in anchors else _type(definitions[name], definitions, anchors)
    for several in ("anyOf", "oneOf"):
        if several in key:
            return " or ".join(dict.fromkeys(_type(each, definitions, anchors) for each in key[several]))
    if "const" in key:
        return f"`{key['const']}`"
    if "enum" in key:
        return ", ".join(f"`{value}`" for value in key["enum"])
    kind = key.get("type", "any value")
    if isinstance(kind, list):
        return " or ".join(_type(key | {"type": each}, definitions, anchors) for each in kind)
    if kind == "array":
        entries = key.get("prefixItems") or [key["items"]]
        count = f"{len(entries)} of: " if "prefixItems" in key else "list of: "
        return count + " or ".join(dict.fromkeys(_type(each, definitions, anchors) for each in entries))
    if kind == "object":
        values = key.get("additionalProperties")
        return (
            "mapping to: " + _type(values, definitions, anchors) if isinstance(values, dict) and values else "mapping"
        )
    if kind in ("number", "integer"):
        signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
        bounds = [f"{sign}\u00a0{key[bound]:,}" for bound, sign in signs.items() if bound in key]
        words = ["whole number" if kind == "integer" else "number", ", ".join(bounds), key.get("unit", "")]
        return "\u00a0".join(word for word in words if word)
    return {"string": "text", "boolean": "true, false", "null": "`null`"}.get(kind, kind)


def dataclass_schema(kind: type) -> dict[str, Any]:
    """JSON schema of a YAML that dataclasses describe, with the notes of their docstrings and comments."""
    from ballmodel.io import validation

    schema = validation.json_schema(kind)
    waiting, parts = [kind], {kind.__name__: schema} | schema.get("$defs", {})
    while waiting:
        owner = waiting.pop()
        part, (summary, notes) = parts[owner.__name__], field_notes(owner)
        part["description"] = summary
        for name, hint in typing.get_type_hints(owner).items():
            part["properties"][name].setdefault("description", notes.get(name, ""))
            waiting += [h for h in (hint, *typing.get_args(hint)) if dataclasses.is_dataclass(h)]
    return schema


def model_page() -> str:
    """Every parameter of the simulation's model, its nominal value and its comment."""
    from ballmodel.io.ranges import Within, find_note, type_hints
    from mjx_tt.sim import model
    from mjx_tt.sim.actuators import DriveParams

    sections: dict[str, dict[str, Any]] = {}
    for path, value in model.paths().items():
        section, key = path.rsplit(".", 1)
        sections.setdefault(section, {})[key] = value
    lines = [
        "# Model",
        "",
        "The YAML of `model` in an experiment, and of `--model`: any of these parameters, nested by",
    ]
    lines += ["section, and `randomise`: what is drawn anew for every episode.", ""]
    lines += [
        "```yaml",
        "ball: {table: {restitution: 0.90}}",
        "randomise:",
        "  ball.paddle.restitution: [0.8, 0.95]    # uniform between the ends",
        "  samples: posterior.csv                  # a row of parameters that belong together",
        "```",
        "",
        "The file of the samples has a column for each parameter, named by its dotted path, and a column `weight`",
        "where rows are not equally likely. In place of the name its content may stand, a list for each column.",
    ]
    joints = [section for section in sections if section.startswith("drives.")]
    for section, values in sections.items():
        if section in joints[1:]:
            continue
        owner: Any = model.SimModel
        for name in section.split("."):
            # The class of the drives is made for a robot's joints: its name tells no type.
            hint = DriveParams if name == "drives" else typing.get_type_hints(owner)[name]
            owner = next(h for h in (hint, *typing.get_args(hint)) if dataclasses.is_dataclass(h))
        summary, notes = field_notes(owner)
        title = "drives.JOINT" if section in joints else section
        lines += ["", f"## {title}", "", _cell(summary), ""]
        lines += ["| key | nominal | allowed | meaning |", "|---|---|---|---|"]
        for key, value in values.items():
            allowed = find_note(type_hints(owner)[key])
            words = str(allowed) if isinstance(allowed, Within) else " or ".join(typing.get_args(allowed))
            lines.append(f"| `{key}` | {_nominal(value)} | {words} | {_cell(notes.get(key, ''))} |")
    return "\n".join(lines) + "\n"


def _nominal(value: float | str) -> str:
    return "none" if isinstance(value, float) and value > 100.0 else f"`{value}`"


def _default(key: dict[str, Any], definitions: dict[str, Any]) -> str:
    """Default of a key; of a section only what differs from the section's own defaults."""
    if "default" not in key:
        return ""
    value, section = key["default"], _section(key, definitions).get("properties", {})
    if isinstance(value, dict) and section:
        value = {name: v for name, v in value.items() if v != section.get(name, {}).get("default")}
        return f"`{json.dumps(value)}`" if value else "its own"
    return f"`{json.dumps(value)}`"


def _section(key: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """Definition of the section that a key holds; empty for other keys."""
    for each in (key, *key.get("anyOf", [])):
        if "$ref" in each:
            return definitions[each["$ref"].removeprefix("#/$defs/")]
    return {}


def _cell(text: str) -> str:
    """Text on one line, for a cell of a table."""
    return " ".join(text.split()).replace("``", "`").replace("|", "\\|")


def command_line_page() -> str:
    """Every command with its arguments and examples."""
    from experiments import cli

    overview, *sections = re.split(r"^(?=## mjx-tt )", cli.app.generate_docs(), flags=re.MULTILINE)
    examples = {f"## mjx-tt {command.name[0]}": command.help_epilogue.strip() for command in cli.COMMANDS}
    lines = ["# Command line", "", "`mjx-tt COMMAND --help` shows the same in a terminal.", ""]
    lines.append(overview[overview.index("**Commands**") :])
    for section in sections:
        lines += [section, "```text", examples[section.splitlines()[0]], "```", ""]
    return "\n".join(lines)


def api_page(package: str, described: dict[int, str]) -> str:
    """Public names of a package: those that its ``__init__`` shows; ``described`` holds objects of earlier pages."""
    module = importlib.import_module(package)
    names = getattr(module, "__all__", None) or [name for name in dir(module) if not name.startswith("_")]
    with contextlib.redirect_stdout(io.StringIO()):  # MJX prints that the optional package warp is absent
        public = {name: getattr(module, name) for name in names if not name.startswith("_")}
    public = {
        name: value
        for name, value in public.items()
        if not isinstance(value, types.ModuleType) and name != "annotations"
    }
    rest = [package, "=" * len(package), "", *(inspect.getdoc(module) or "").splitlines(), ""]
    objects = [name for name in sorted(public) if callable(public[name])]
    own = [name for name in objects if id(public[name]) not in described]
    if own:
        rest += [".. autosummary::", "   :nosignatures:", "", *(f"   {package}.{name}" for name in own), ""]
    for name in sorted(set(public) - set(objects)):
        rest += [f".. py:data:: {package}.{name}", f"   :value: {textwrap.shorten(repr(public[name]), 160)}", ""]
    for name in objects:
        value = public[name]
        if id(value) in described:
            rest += [f"``{package}.{name}`` is :class:`{described[id(value)]}`.", ""]
            continue
        if inspect.isclass(value):
            described[id(value)] = f"{package}.{name}"
        kind = "class" if inspect.isclass(value) else "function"
        rest += [f".. auto{kind}:: {package}.{name}", *(["   :members:"] if kind == "class" else []), ""]
    return "\n".join(rest)


def _write(name: str, text: str) -> None:
    path = GENERATED / f"{name}{'.rst' if name.startswith('api-') else '.md'}"
    if not path.exists() or path.read_text("utf-8") != text:
        path.write_text(text, encoding="utf-8")
