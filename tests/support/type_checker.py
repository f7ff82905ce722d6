"""The type checker of the import hook in ``tests/conftest.py``."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from beartype import BeartypeConf, beartype

CHECKING = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a float
F = TypeVar("F", bound=Callable)


def checked(function: F) -> F:
    """beartype for all but constructors: JAX fills pytrees with specs, shapes and sentinels."""
    return function if function.__name__ == "__init__" else CHECKING(function)
