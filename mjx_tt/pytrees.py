"""Dataclasses of arrays: what a compiled function takes, carries and returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar, dataclass_transform

import jax

T = TypeVar("T")


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def pytree(cls: type[T]) -> type[T]:
    """Makes a class a frozen dataclass whose fields are leaves to JAX, but for those with metadata ``static``: True."""
    return jax.tree_util.register_dataclass(dataclass(frozen=True)(cls))
