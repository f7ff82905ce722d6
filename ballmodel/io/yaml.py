"""YAML as every file of the project is read: 1e-3 is a number, and a key given twice is a mistake."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import yaml


class _Loader(yaml.SafeLoader):
    """SafeLoader that reads 1e-3 as a number, as YAML 1.2 does, and refuses a key given twice."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict:
    nodes = [key for key, _ in node.value if key.tag != "tag:yaml.org,2002:merge"]  # <<: *name, which keys change
    keys = [loader.construct_object(key, deep=True) for key in nodes]
    for i, key in enumerate(keys):
        if key in keys[:i]:
            mark = nodes[i].start_mark
            raise yaml.constructor.ConstructorError(None, None, f"key {key!r} is given twice", mark)
    return yaml.SafeLoader.construct_mapping(loader, node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:map", _mapping)


def parse(text: str, where: str) -> Any:
    """The content of YAML text. Raises ValueError naming ``where`` and the line."""
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise ValueError(f"{where}: not valid YAML: {' '.join(str(error).split())}") from None


def read(path: str | os.PathLike) -> Any:
    """The content of a YAML file. Raises ValueError naming the file, OSError where it cannot be opened."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file in UTF-8: {error}") from None
    return parse(text, str(path))
