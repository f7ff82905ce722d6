"""Checkpoints that are whole or absent, from which a run continues bit for bit.

A checkpoint is one .npz: every leaf of a pytree under its path in the tree, and notes as JSON under ``NOTES``. It is
written to a temporary file, forced to the disk and renamed, and the one before it is kept.
"""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from ballmodel.io.atomic_files import replacing, sync_folder
from experiments.errors import CheckpointError
from mjx_tt.env.rollout import held_here

NOTES = "notes"
KEPT = 2
Tree = TypeVar("Tree")


def save(folder: Path, update: int, tree: Any, notes: dict[str, Any]) -> Path:
    """Writes the state after ``update`` updates and removes all but the last two checkpoints.

    Raises CheckpointError when the disk refuses; earlier checkpoints are untouched.
    """
    path = folder / f"{update:08d}.npz"
    # Any: a keyword of savez may also be one of its options.
    arrays: dict[str, Any] = pack(tree) | {NOTES: np.array(json.dumps(notes | {"update": update}))}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary, open(temporary, "wb") as file:
            np.savez(file, **arrays)
            file.flush()
            os.fsync(file.fileno())
        sync_folder(folder)
    except OSError as error:
        left = _paths(folder)
        kept = f"the last checkpoint is whole: {left[-1]}" if left else "there is no earlier checkpoint"
        raise CheckpointError(
            f"{path}: cannot be written: {error.strerror or error}; {kept}. "
            "Make room or repair the folder, then run the same command again to continue"
        ) from error
    for old in _paths(folder)[:-KEPT]:
        old.unlink(missing_ok=True)
    return path


def load_latest(folder: Path, template: Tree) -> tuple[Tree, dict[str, Any]] | None:
    """The newest readable state and its notes, shaped as ``template``; None when the folder has no checkpoint.

    Raises CheckpointError when there are checkpoints but none fits.
    """
    found = read_latest(folder)
    if found is None:
        return None
    return unpack(found[0], template, str(folder)), found[1]


def pack(tree: Any) -> dict[str, np.ndarray]:
    """The leaves of a tree by their paths in it, random keys as their data."""
    return {name: np.asarray(_data(leaf)) for name, leaf in _named_leaves(tree).items()}


def unpack(arrays: dict[str, np.ndarray], template: Tree, where: str) -> Tree:
    """The tree of packed leaves, shaped as ``template``; ``where`` they are from.

    Raises CheckpointError where they are another program's.
    """
    wanted = _named_leaves(template)
    if set(wanted) != set(arrays):
        raise CheckpointError(f"{where}: holds {sorted(arrays)}, this program's state is {sorted(wanted)}")
    leaves = []
    for name, leaf in wanted.items():
        found, like = arrays[name], _data(leaf)
        if (found.shape, found.dtype) != (like.shape, like.dtype):
            given = f"{found.dtype} {found.shape}"
            raise CheckpointError(f"{where}: {name} is {given}, wanted is {like.dtype} {like.shape}")
        array = jnp.asarray(found)
        leaves.append(jax.random.wrap_key_data(array, impl=jax.random.key_impl(leaf)) if _is_key(leaf) else array)
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def read_latest(folder: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
    """Arrays by path and notes of the newest readable checkpoint; None when the folder has none.

    Raises CheckpointError when none of several is readable.
    """
    complaints = []
    for path in reversed(_paths(folder)):
        try:
            with np.load(path, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files}
            return arrays, json.loads(str(arrays.pop(NOTES)))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            complaints.append(f"{path}: {error}")
    if complaints:
        raise CheckpointError(f"no checkpoint can be read: {'; '.join(complaints)}")
    return None


def newest(folder: Path) -> int:
    """Updates after which the last checkpoint was made, 0 without one."""
    return max((int(path.stem) for path in _paths(folder)), default=0)


def _paths(folder: Path) -> list[Path]:
    """Checkpoints in the order of their updates."""
    return sorted(folder.glob("[0-9]*.npz"))


def _named_leaves(tree: Any) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(held_here(tree))
    return {jax.tree_util.keystr(path).removeprefix("."): leaf for path, leaf in leaves}


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _data(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf
