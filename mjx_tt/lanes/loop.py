"""Loops over time that run lane by lane, with the state of a few lanes in registers and the nearest cache.

XLA runs each operation over all lanes of a batch before the next one, so what lies between goes to memory and back.
Here a step of the loop is one function on a vector of lanes (``machine.width``), which run from the first tick to the
last before the next ones begin. On NVIDIA's accelerators the whole loop is one kernel with a thread for each lane.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.extend import core
from jaxtyping import Bool, Int

from mjx_tt.lanes import cuda, kernel, machine
from mjx_tt.lanes.emitter import Emitter, Unsupported
from mjx_tt.lanes.frame import Operand
from mjx_tt.lanes.handler import handler
from mjx_tt.lanes.memory import Slots
from mjx_tt.lanes.programs import emit_step
from mjx_tt.lanes.values import LANES, Form

S = TypeVar("S")
Step = Callable[[Int[Array, ""], S, Any, Any], S]

log = logging.getLogger(__name__)
_NAMES: dict[str, str] = {}  # by the module's text: the name under which XLA finds its machine code


def while_any(
    live: Callable[[S], Bool[Array, " L"]],
    step: Step,
    state: S,
    by_lane: Any = (),
    by_column: Any = (),
    *,
    limit: int,
    lanes: bool = True,
) -> S:
    """``state`` after ``step(tick, state, by_lane, by_column)`` for tick 0, 1, ... while any lane is ``live``.

    state: a pytree of arrays (..., L) of one number of lanes L, or (..., R, P) with R x P = L
    by_lane: likewise, or scalars that all lanes share
    by_column: arrays (..., P), of which lane l gets column l mod P, or arrays of one axis that all lanes share
    live: picks a Boolean array of the state, without computing anything
    limit: most ticks
    lanes: False leaves the loop to XLA, as do other accelerators than NVIDIA's, and programs with an operation that the
    compiler for lanes does not know (the log says which one)

    A lane that is not live any more may be stepped on, for as long as others of its batch are live.
    """
    if lanes and (cuda.present() or jax.default_backend() == "cpu"):
        try:
            return _by_lanes(live, step, state, by_lane, by_column, limit)
        except Unsupported as reason:
            log.info("a loop is left to XLA: %s", reason)
    return _by_xla(live, step, state, by_lane, by_column, limit)


def compiled() -> list[str]:
    """LLVM's text of the loops that this process compiled lane by lane, in order."""
    return list(_NAMES)


def _by_xla(live: Callable, step: Step, state: S, by_lane: Any, by_column: Any, limit: int) -> S:
    def running(carry: tuple[Array, S]) -> Array:
        return (carry[0] < limit) & jnp.any(live(carry[1]))

    def advance(carry: tuple[Array, S]) -> tuple[Array, S]:
        tick, now = carry
        return tick + 1, step(tick, now, by_lane, by_column)

    return jax.lax.while_loop(running, advance, (jnp.int32(0), state))[1]


def _by_lanes(live: Callable, step: Step, state: S, by_lane: Any, by_column: Any, limit: int) -> S:
    """Raises Unsupported."""
    lanes = live(state).shape[-1]
    trees = (state, by_lane, by_column)
    try:
        whole = [jnp.asarray(x) for x in jax.tree.leaves(trees)]
    except TypeError as error:
        raise Unsupported(f"an argument that is no array: {error}") from error
    n = len(jax.tree.leaves(state))
    arrays = [_in_one_row(x, lanes) if i < n else x for i, x in enumerate(whole)]
    structure = jax.tree.structure(trees)
    kinds = [
        "shared" if jnp.ndim(x) == 0 or (kind == "column" and jnp.ndim(x) == 1) else kind
        for tree, kind in zip(trees, ("state", "lane", "column"), strict=True)
        for x in jax.tree.leaves(tree)
    ]
    _check(arrays, kinds, n)
    shapes = [
        jax.ShapeDtypeStruct(x.shape if kind == "shared" else (*x.shape[:-1], LANES), x.dtype)
        for x, kind in zip(arrays, kinds, strict=True)
    ]

    def flat(tick: Array, *leaves: Array) -> list[Array]:
        return jax.tree.leaves(step(tick, *jax.tree.unflatten(structure, leaves)))

    try:
        traced = jax.make_jaxpr(flat)(jax.ShapeDtypeStruct((), jnp.int32), *shapes)
    except (TypeError, ValueError) as error:  # such as a sum with an array of L lanes that the step closes over
        raise Unsupported(f"tracing with {LANES} lanes: {error}") from error
    if [(x.shape, x.dtype) for x in traced.out_avals] != [(x.shape, x.dtype) for x in shapes[:n]]:
        raise Unsupported("a step that changes the state's form")
    numbers = jax.tree.unflatten(structure, range(len(arrays)))
    operands, used = _operands(shapes, kinds)
    ends = int(live(numbers[0])), limit
    if cuda.present():
        columns = next((x.shape[-1] for x, kind in zip(arrays, kinds, strict=True) if kind == "column"), lanes)
        text = kernel.module(traced, operands, lanes, columns, *ends)
        name = _registered(text, lambda folder: cuda.compiled(text, operands, lanes, folder), cuda.PLATFORM)
    else:
        text = _module(traced, operands, used, *ends)
        name = _registered(text, lambda folder: machine.compiled(text, "handler", folder), "cpu")
    results = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays[:n]]
    done = jax.ffi.ffi_call(name, results, vmap_method="sequential")(*arrays)
    shaped = [x.reshape(was.shape) for x, was in zip(done, whole, strict=False)]
    return jax.tree.unflatten(jax.tree.structure(state), shaped)


def _in_one_row(x: Array, lanes: int) -> Array:
    """(..., R, P) with R x P lanes as (..., 1, L)."""
    folded = x.ndim > 1 and x.shape[-1] != lanes and x.shape[-2] * x.shape[-1] == lanes
    return x.reshape(*x.shape[:-2], 1, lanes) if folded else x


def _check(arrays: list[Array], kinds: list[str], n_state: int) -> None:
    if "shared" in kinds[:n_state]:
        raise Unsupported("a scalar in the state")
    for among in ({"state", "lane"}, {"column"}):
        last = {x.shape[-1] for x, kind in zip(arrays, kinds, strict=True) if kind in among}
        if len(last) > 1:
            raise Unsupported(f"last axes of {sorted(last)} where one number of {'/'.join(sorted(among))}s is needed")
        if 0 in last:
            raise Unsupported("no lanes")


def _operands(shapes: list, kinds: list[str]) -> tuple[list[Operand], dict[str, int]]:
    """The arrays of a call, and the number of slots in each place."""
    operands, used = [], {"state": 0, "own": 0, "shared": 0}
    for shape, kind in zip(shapes, kinds, strict=True):
        operand = Operand(kind, Form.of(shape), 0)
        operands.append(replace(operand, begin=used[operand.place]))
        used[operand.place] += operand.form.size
    return operands, used


def _module(traced: core.ClosedJaxpr, operands: list[Operand], used: dict[str, int], live: int, limit: int) -> str:
    """LLVM's text of a loop on this processor."""
    e = Emitter(machine.width())
    memory = {place: Slots(e, f"%{place}") for place in used}
    values = [memory[o.place].value(o.form, o.begin) for o in operands]
    results = emit_step(e, traced, values)
    states = [o for o in operands if o.kind == "state"]
    n = len(states)
    memory["state"].replace(values[:n], results, [o.form for o in states], [o.begin for o in states])
    head = "define internal void @step(ptr noalias %state, ptr noalias %own, ptr noalias %shared, i32 %tick)"
    step = "\n".join([head, "nounwind noinline {", *e.entry, *e.lines, "ret void", "}"])
    return step + handler(operands, used, live, limit, e.width)


def _registered(text: str, address: Callable[[Path | None], ctypes.c_void_p], platform: str) -> str:
    """XLA's name of a text's machine code."""
    if text not in _NAMES:
        name = f"mjx_tt_lanes_{hashlib.sha256(text.encode()).hexdigest()[:32]}"
        kept = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]  # defined where JAX starts
        found = address(Path(kept) / "lanes" if kept else None)
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(found), platform=platform)
        _NAMES[text] = name
    return _NAMES[text]
