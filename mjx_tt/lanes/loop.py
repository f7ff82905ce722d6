"""A loop over time that runs lane by lane: the state of a few episodes stays in registers and the first-level cache.

XLA runs every operation over the whole batch before the next, so most of a control step goes to and from memory. Here
a step is one function on a vector of lanes, and ``width`` lanes run from beginning to end before the next ones start.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from jax import Array

from mjx_tt.lanes import machine, programs
from mjx_tt.lanes.emitter import Emitter, Unsupported, type_of
from mjx_tt.lanes.programs import LANES, Slots, Value

S = TypeVar("S")


def while_live(
    body: Callable[[Array, S, Any, Any], S],
    live: Callable[[S], Array],
    state: S,
    by_lane: Any,
    by_column: Any,
    limit: int,
) -> S:
    """``state`` after ``body(tick, state, by_lane, by_column)`` for tick 0, 1, ... while a lane is live, ``limit`` at most.

    A lane that is no longer live must keep its state. Arrays of ``state`` have the lanes (L,) as their last axis; those of
    ``by_lane`` too, or are scalars; those of ``by_column`` have P columns as last axis, of which lane l has column l % P,
    or are of one axis and shared. Raises Unsupported.
    """
    groups = _Operands.of(state, by_lane, by_column)
    name = _compiled(body, live, groups, limit)
    leaves = groups.arrays
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves[: groups.n_state]]
    results = jax.ffi.ffi_call(name, shapes, vmap_method="sequential")(*leaves)
    return jax.tree.unflatten(groups.trees[0], results)


class _Operands:
    """The arrays of a loop: state, by lane, by column and shared ones."""

    def __init__(self, trees: list, arrays: list[Array], kinds: list[str]) -> None:
        self.trees, self.arrays, self.kinds = trees, arrays, kinds
        self.n_state = kinds.count("state")

    @classmethod
    def of(cls, state: Any, by_lane: Any, by_column: Any) -> _Operands:
        arrays: list[Array] = []
        kinds: list[str] = []
        trees = []
        for tree, kind in ((state, "state"), (by_lane, "lane"), (by_column, "column")):
            leaves, structure = jax.tree.flatten(tree)
            trees.append(structure)
            for x in leaves:
                x = jax.numpy.asarray(x)
                shared = kind != "state" and (x.ndim == 0 or (kind == "column" and x.ndim == 1))
                arrays.append(x)
                kinds.append("shared" if shared else kind)
        for among in (("state", "lane"), ("column",)):
            lasts = {x.shape[-1:] for x, kind in zip(arrays, kinds, strict=True) if kind in among}
            if len(lasts) > 1 or () in lasts:
                raise Unsupported(f"last axes {sorted(lasts)} of arrays by {' and '.join(among)}")
        return cls(trees, arrays, kinds)

    def avals(self) -> list[jax.ShapeDtypeStruct]:
        shapes = []
        for x, kind in zip(self.arrays, self.kinds, strict=True):
            shapes.append(jax.ShapeDtypeStruct(x.shape if kind == "shared" else (*x.shape[:-1], LANES), x.dtype))
        return shapes

    def split(self, leaves: list) -> tuple[Any, Any, Any]:
        out, i = [], 0
        for tree in self.trees:
            out.append(jax.tree.unflatten(tree, leaves[i : i + tree.num_leaves]))
            i += tree.num_leaves
        return tuple(out)


def _compiled(body: Callable, live: Callable, groups: _Operands, limit: int) -> str:
    """Name under which XLA finds the loop."""

    def step(tick: Array, *leaves: Array) -> list[Array]:
        state, by_lane, by_column = groups.split(list(leaves))
        return jax.tree.leaves(body(tick, state, by_lane, by_column))

    avals = groups.avals()
    traced = jax.make_jaxpr(step)(jax.ShapeDtypeStruct((), np.int32), *avals)
    before = [(x.shape, x.dtype) for x in avals[: groups.n_state]]
    after = [(x.shape, x.dtype) for x in traced.out_avals]
    if before != after:
        raise Unsupported("a state that changes its form")
    leaves = list(range(len(avals)))
    live_leaf = live(groups.split(leaves)[0])
    text = _module(traced, groups, live_leaf, limit)
    return _registered(text)


def _module(traced: Any, groups: _Operands, live_leaf: int, limit: int) -> str:
    w = machine.width()
    e = Emitter(w)
    begins: list[int] = []
    used = {"state": 0, "own": 0, "shared": 0}
    values: list[Value] = []
    slots = {part: Slots(e, f"%{part}") for part in used}
    avals = groups.avals()
    for aval, kind in zip(avals, groups.kinds, strict=True):
        part = {"state": "state", "shared": "shared"}.get(kind, "own")
        shape, laned = programs.shape_of(aval)
        size, dtype = math.prod(shape), np.dtype(aval.dtype)
        begins.append(used[part])
        elements = [slots[part].load(used[part] + i, dtype, laned) for i in range(size)]
        values.append(Value(dtype, shape, elements))
        used[part] += size
    tick = Value(np.dtype(np.int32), (), [programs.Element(programs.Kind.SCALAR, "%tick")])
    results = programs.emit(e, traced.jaxpr, list(traced.consts), [tick, *values])
    n = groups.n_state
    programs.store_all(e, slots["state"], results, values[:n], begins[:n], [True] * n)
    step = "\n".join(
        [
            "define internal void @step(ptr noalias %state, ptr noalias %own, ptr noalias %shared, i32 %tick) #0 {",
            *e.entry,
            *e.lines,
            "ret void",
            "}",
        ]
    )
    text = step + _handler(avals, groups.kinds, begins, used, live_leaf, limit, w)
    return text + "\nattributes #0 = { nounwind noinline }\n"


def _copies(w: int) -> str:
    """Between a batch's arrays, one row for each element, and slots."""
    text = ""
    for bits in (8, 32):
        t, size = f"i{bits}", bits // 8
        text += f"""
define internal void @in{bits}(ptr noalias %slots, ptr noalias %array, i64 %n, i64 %stride, ptr noalias %index) nounwind noinline {{
  br label %rows
rows:
  %e = phi i64 [0, %0], [%e1, %next]
  %done = icmp sge i64 %e, %n
  br i1 %done, label %end, label %row
row:
  %base = mul i64 %e, %stride
  %from = getelementptr i8, ptr %slots, i64 0
  %slot = mul i64 %e, {w * 4}
  %to = getelementptr i8, ptr %slots, i64 %slot
  br label %lanes
lanes:
  %k = phi i64 [0, %row], [%k1, %lanes]
  %p = getelementptr i64, ptr %index, i64 %k
  %i = load i64, ptr %p
  %place = add i64 %base, %i
  %source = getelementptr {t}, ptr %array, i64 %place
  %x = load {t}, ptr %source
  %target = getelementptr {t}, ptr %to, i64 %k
  store {t} %x, ptr %target
  %k1 = add i64 %k, 1
  %more = icmp slt i64 %k1, {w}
  br i1 %more, label %lanes, label %next
next:
  %e1 = add i64 %e, 1
  br label %rows
end:
  ret void
}}
define internal void @out{bits}(ptr noalias %slots, ptr noalias %array, i64 %n, i64 %stride, i64 %first, i64 %count) nounwind noinline {{
  br label %rows
rows:
  %e = phi i64 [0, %0], [%e1, %next]
  %done = icmp sge i64 %e, %n
  br i1 %done, label %end, label %row
row:
  %start = mul i64 %e, %stride
  %base = add i64 %start, %first
  %slot = mul i64 %e, {w * 4}
  %from = getelementptr i8, ptr %slots, i64 %slot
  br label %lanes
lanes:
  %k = phi i64 [0, %row], [%k1, %lanes]
  %source = getelementptr {t}, ptr %from, i64 %k
  %x = load {t}, ptr %source
  %place = add i64 %base, %k
  %target = getelementptr {t}, ptr %array, i64 %place
  store {t} %x, ptr %target
  %k1 = add i64 %k, 1
  %more = icmp slt i64 %k1, %count
  br i1 %more, label %lanes, label %next
next:
  %e1 = add i64 %e, 1
  br label %rows
end:
  ret void
}}
"""
    return text


def _handler(avals, kinds, begins, used, live_leaf, limit, w) -> str:
    """The function that XLA calls: XLA_FFI_Handler of xla/ffi/api/c_api.h, by its offsets."""
    major, minor = _api_version()
    lines = [
        "  %extension_at = getelementptr i8, ptr %frame, i64 8",
        "  %extension = load ptr, ptr %extension_at",
        "  %asked = icmp ne ptr %extension, null",
        "  br i1 %asked, label %metadata, label %execute",
        "metadata:",
        "  %metadata_at = getelementptr i8, ptr %extension, i64 24",
        "  %about = load ptr, ptr %metadata_at",
        "  %major = getelementptr i8, ptr %about, i64 24",
        f"  store i32 {major}, ptr %major",
        "  %minor = getelementptr i8, ptr %about, i64 28",
        f"  store i32 {minor}, ptr %minor",
        "  %traits = getelementptr i8, ptr %about, i64 32",
        "  store i32 0, ptr %traits",
        "  ret ptr null",
        "execute:",
        "  %args_at = getelementptr i8, ptr %frame, i64 72",
        "  %args = load ptr, ptr %args_at",
        "  %rets_at = getelementptr i8, ptr %frame, i64 112",
        "  %rets = load ptr, ptr %rets_at",
        f"  %state = alloca [{max(1, used['state']) * w * 4} x i8], align 64",
        f"  %own = alloca [{max(1, used['own']) * w * 4} x i8], align 64",
        f"  %shared = alloca [{max(1, used['shared']) * w * 4} x i8], align 64",
        f"  %lane = alloca [{w} x i64], align 64",
        f"  %column = alloca [{w} x i64], align 64",
        f"  %zeros = alloca [{w} x i64], align 64",
        f"  call void @llvm.memset.p0.i64(ptr %zeros, i8 0, i64 {w * 8}, i1 false)",
    ]
    n_state = kinds.count("state")
    sizes = [math.prod(programs.shape_of(a)[0]) for a in avals]
    bits = [8 if type_of(a.dtype) in ("i1", "i8") else 32 for a in avals]

    def buffer(i: int, table: str, name: str) -> None:
        lines.extend(
            [
                f"  %{name}_p = getelementptr ptr, ptr %{table}, i64 {i}",
                f"  %{name}_b = load ptr, ptr %{name}_p",
                f"  %{name}_d = getelementptr i8, ptr %{name}_b, i64 24",
                f"  %{name} = load ptr, ptr %{name}_d",
            ]
        )

    def last_axis(i: int, name: str) -> None:
        rank = len(avals[i].shape)
        lines.extend(
            [
                f"  %{name}_q = getelementptr i8, ptr %a{i}_b, i64 40",
                f"  %{name}_dims = load ptr, ptr %{name}_q",
                f"  %{name}_at = getelementptr i64, ptr %{name}_dims, i64 {rank - 1}",
                f"  %{name} = load i64, ptr %{name}_at",
            ]
        )

    for i in range(len(avals)):
        buffer(i, "args", f"a{i}")
    for i in range(n_state):
        buffer(i, "rets", f"r{i}")
    last_axis(0, "lanes")
    columns = [i for i, kind in enumerate(kinds) if kind == "column"]
    if columns:
        last_axis(columns[0], "columns")
    else:
        lines.append("  %columns = add i64 0, 1")
    for i, kind in enumerate(kinds):
        if kind == "shared":
            lines.append(f"  %s{i} = getelementptr i8, ptr %shared, i64 {begins[i] * w * 4}")
            lines.append(f"  call void @in{bits[i]}(ptr %s{i}, ptr %a{i}, i64 {sizes[i]}, i64 1, ptr %zeros)")
    lines += [
        "  %last = sub i64 %lanes, 1",
        "  br label %groups",
        "groups:",
        "  %first = phi i64 [0, %execute], [%first1, %leave]",
        "  %finished = icmp sge i64 %first, %lanes",
        "  br i1 %finished, label %end, label %number",
        "number:",
        "  %k = phi i64 [0, %groups], [%k1, %number]",
        "  %l0 = add i64 %first, %k",
        "  %l = call i64 @llvm.smin.i64(i64 %l0, i64 %last)",
        "  %lp = getelementptr i64, ptr %lane, i64 %k",
        "  store i64 %l, ptr %lp",
        "  %c = urem i64 %l, %columns",
        "  %cp = getelementptr i64, ptr %column, i64 %k",
        "  store i64 %c, ptr %cp",
        "  %k1 = add i64 %k, 1",
        f"  %numbered = icmp sge i64 %k1, {w}",
        "  br i1 %numbered, label %enter, label %number",
        "enter:",
    ]
    for i, kind in enumerate(kinds):
        if kind == "shared":
            continue
        part = "state" if kind == "state" else "own"
        index, stride = ("%column", "%columns") if kind == "column" else ("%lane", "%lanes")
        lines.append(f"  %g{i} = getelementptr i8, ptr %{part}, i64 {begins[i] * w * 4}")
        lines.append(f"  call void @in{bits[i]}(ptr %g{i}, ptr %a{i}, i64 {sizes[i]}, i64 {stride}, ptr {index})")
    lines += [
        f"  %live_at = getelementptr i8, ptr %state, i64 {begins[live_leaf] * w * 4}",
        "  br label %ticks",
        "ticks:",
        "  %tick = phi i32 [0, %enter], [%tick1, %advance]",
        f"  %live = load <{w} x i8>, ptr %live_at",
        f"  %some = call i8 @llvm.vector.reduce.or.v{w}i8(<{w} x i8> %live)",
        "  %running = icmp ne i8 %some, 0",
        f"  %early = icmp slt i32 %tick, {limit}",
        "  %go = and i1 %running, %early",
        "  br i1 %go, label %advance, label %leave",
        "advance:",
        "  call void @step(ptr %state, ptr %own, ptr %shared, i32 %tick)",
        "  %tick1 = add i32 %tick, 1",
        "  br label %ticks",
        "leave:",
        "  %left = sub i64 %lanes, %first",
        f"  %count = call i64 @llvm.smin.i64(i64 %left, i64 {w})",
    ]
    for i in range(n_state):
        lines.append(
            f"  call void @out{bits[i]}(ptr %g{i}, ptr %r{i}, i64 {sizes[i]}, i64 %lanes, i64 %first, i64 %count)"
        )
    lines += [f"  %first1 = add i64 %first, {w}", "  br label %groups", "end:", "  ret ptr null"]
    return _copies(w) + "\ndefine ptr @handler(ptr %frame) nounwind {\n" + "\n".join(lines) + "\n}\n"


@cache
def _api_version() -> tuple[int, int]:
    header = (Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h").read_text()
    found = dict(re.findall(r"#define XLA_FFI_API_(MAJOR|MINOR) (\d+)", header))
    return int(found["MAJOR"]), int(found["MINOR"])


_REGISTERED: dict[str, str] = {}


def _registered(text: str) -> str:
    if text not in _REGISTERED:
        name = f"mjx_tt_lanes_{hashlib.sha256(text.encode()).hexdigest()[:24]}"
        directory = jax.config.jax_compilation_cache_dir
        address = machine.compile(text, "handler", Path(directory).parent / "lanes" if directory else None)
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform="cpu")
        _REGISTERED[text] = name
    return _REGISTERED[text]
