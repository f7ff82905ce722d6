"""A traced JAX program as instructions for one vector of lanes."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.extend import core

from mjx_tt.lanes.arithmetic import elementwise, known
from mjx_tt.lanes.emitter import Element, Emitter, Kind, Unsupported
from mjx_tt.lanes.functions import EXPANSIONS
from mjx_tt.lanes.memory import Slots, begins_of
from mjx_tt.lanes.values import LANES, RULES, Form, Value, of_constants, spread

_INLINED = {"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint"}
# Where arrays lie and what is stored means nothing for numbers in registers.
_INERT = {"optimization_barrier", "reshard", "sharding_constraint", "pvary", "pcast"}


def emit(e: Emitter, jaxpr: core.Jaxpr, constants: list[Any], arguments: list[Value]) -> list[Value]:
    """The program's results for its arguments. Raises Unsupported."""
    values: dict[Any, Value] = dict(zip(jaxpr.constvars, map(of_constants, constants), strict=True))
    values |= zip(jaxpr.invars, arguments, strict=True)

    def read(atom: Any) -> Value:
        if isinstance(atom, core.Literal):
            return of_constants(np.asarray(atom.val, Form.of(atom.aval).dtype))
        return values[atom]

    for equation in jaxpr.eqns:
        results = _apply(e, equation, [read(atom) for atom in equation.invars])
        values |= zip(equation.outvars, results, strict=True)
    return [read(atom) for atom in jaxpr.outvars]


def emit_step(e: Emitter, step: core.ClosedJaxpr, arguments: list[Value]) -> list[Value]:
    """The results of a loop's step for its number %tick and these arguments. Raises Unsupported."""
    tick = Value(np.dtype(np.int32), (), [Element(Kind.SCALAR, "%tick")])
    return emit(e, step.jaxpr, list(step.consts), [tick, *arguments])


def _apply(e: Emitter, equation: core.JaxprEqn, operands: list[Value]) -> list[Value]:
    name, params = equation.primitive.name, equation.params
    if name in _INLINED:
        inner = next(params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in params)
        return emit(e, getattr(inner, "jaxpr", inner), list(getattr(inner, "consts", ())), operands)
    if name in _INERT:
        return operands
    if name == "scan":
        return _scan(e, params, operands)
    forms, outs = ([Form.of(v.aval) for v in variables] for variables in (equation.invars, equation.outvars))
    if name == "unstack":  # from JAX 0.11 on
        rows = np.moveaxis(operands[0].places, forms[0].without(params["axis"]), 0)
        return [operands[0].pick(row) for row in rows]
    if len(outs) != 1:
        raise Unsupported(f"the operation {name}")
    (out,) = outs
    if name in RULES:
        return [RULES[name](e, operands, forms, out, params)]
    if name in EXPANSIONS:
        if out.dtype != np.float32:
            raise Unsupported(f"{name} of {out.dtype}")
        traced = jax.make_jaxpr(EXPANSIONS[name])(jax.ShapeDtypeStruct(out.whole, out.dtype))
        return emit(e, traced.jaxpr, list(traced.consts), operands)
    if not known(name):
        raise Unsupported(f"the operation {name}")
    dtypes = [x.dtype for x in operands]
    each = zip(*(spread(x, form, out) for x, form in zip(operands, forms, strict=True)), strict=True)
    return [Value(out.dtype, out.shape, [elementwise(e, name, one, dtypes, out.dtype, params) for one in each])]


def _counts(params: dict) -> tuple[int, int]:
    """Numbers of a scan's constants and of what it carries."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    constants, carried, _ = params["ft_in"].unpack()  # from JAX 0.11 on
    return len(constants), len(carried)


def _scan(e: Emitter, params: dict, operands: list[Value]) -> list[Value]:
    """A loop with a known number of rounds stays a loop: unrolled, its code would not fit the instruction cache."""
    length, n_constants, n_carried = params["length"], *_counts(params)
    jaxpr = params["jaxpr"].jaxpr
    if len(jaxpr.outvars) > n_carried or length in (0, LANES):
        raise Unsupported("a scan that stacks results, or one of no rounds")
    fixed, carried = operands[:n_constants], operands[n_constants : n_constants + n_carried]
    rows = operands[n_constants + n_carried :]
    forms = [Form.of(v.aval) for v in jaxpr.invars[n_constants:]]
    forms, row_forms = forms[:n_carried], forms[n_carried:]
    begins = begins_of(forms)
    slots = Slots(e, e.reserve(begins.pop() * e.width * 4))
    for value, form, begin in zip(carried, forms, begins, strict=True):
        for i, element in enumerate(value.elements):
            slots.store(begin + i, element, form.dtype, form.laned)
    tables = []  # what a round reads by its number
    for value, form in zip(rows, row_forms, strict=True):
        tables.append(e.reserve(len(value.elements) * e.width * 4))
        for i, element in enumerate(value.elements):
            Slots(e, tables[-1]).store(i, element, form.dtype, form.laned)

    counter, label = e.reserve(8, 8), e.name().removeprefix("%")
    e.do(f"store i64 0, ptr {counter}")
    e.do(f"br label %loop_{label}")
    e.do(f"loop_{label}:")
    done = e.again(f"load i64, ptr {counter}")
    number = e.again(f"sub i64 {length - 1}, {done}") if params["reverse"] else done
    before = [slots.value(form, begin) for form, begin in zip(forms, begins, strict=True)]
    read = []
    for pointer, form in zip(tables, row_forms, strict=True):
        offset = e.again(f"mul i64 {number}, {form.size * e.width * 4}")
        read.append(Slots(e, e.again(f"getelementptr inbounds i8, ptr {pointer}, i64 {offset}")).value(form, 0))
    after = emit(e, jaxpr, list(params["jaxpr"].consts), [*fixed, *before, *read])
    slots.replace(before, after, forms, begins)
    next_ = e.again(f"add i64 {done}, 1")
    e.do(f"store i64 {next_}, ptr {counter}")
    more = e.again(f"icmp slt i64 {next_}, {length}")
    e.do(f"br i1 {more}, label %loop_{label}, label %end_{label}")
    e.do(f"end_{label}:")
    return [slots.value(form, begin) for form, begin in zip(forms, begins, strict=True)]
