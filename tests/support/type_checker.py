"""The type checker of the import hook in ``tests/conftest.py``."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from beartype import beartype

F = TypeVar("F", bound=Callable)


def checked(function: F) -> F:
    """beartype for all but constructors: JAX fills pytrees with specs, shapes and sentinels."""
    return function if function.__name__ == "__init__" else beartype(function)
