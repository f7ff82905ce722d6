"""Reward terms and networks of a user's own, from a Python file that an experiment's key ``definitions`` names.

    from mjx_tt.env.own import network, reward_term

    @reward_term("calm_wrist")
    def calm_wrist(step):  # a ControlStep: the term is the mean over the control steps under the policy
        return -abs(step.command[7])

    @reward_term("deep", per="ball")
    def deep(ball):  # a PlayedBall: the term is this number
        return ball.returned * ball.landing[1]

Functions get JAX arrays with the batch on the last axes and return one number an episode; they are traced once and
compiled with everything else. docs/how-to/define-a-task.md has a complete example.
"""

from __future__ import annotations

import linecache
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from ballmodel.flight import PaddlePose
from mjx_tt.env import rewards
from robot_io.contract import PAPER, Contract, unflatten
from robot_io.policy.policy import Policy

F = TypeVar("F", bound=Callable)
State: TypeAlias = Any  # a pytree of arrays, whatever a network remembers
Parameters: TypeAlias = Mapping[str, Array]

BATCH = (2, 3)  # of the trial calls that check what a user's function returns


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ControlStep:
    """One control period under the policy, as it is at its end. SI units, the batch last."""

    # ball [m] and joints [m, rad] as the policy saw them, late and with noise
    observation: Float[Array, "observed *batch"]
    command: Float[Array, "joints *batch"]  # [m/s, rad/s] velocities after the limits
    acceleration: Float[Array, "joints *batch"]  # [m/s^2, rad/s^2] change of the command
    joints: Float[Array, "joints *batch"]  # [m, rad] true positions
    blade: PaddlePose  # position [m], normal, velocity [m/s], angular_velocity [rad/s] of the blade's centre
    ball_position: Float[Array, "3 *batch"]  # [m] true
    ball_velocity: Float[Array, "3 *batch"]  # [m/s]
    bounced: Bool[Array, "*batch"]  # the ball has bounced on the robot's side
    table_gap: Float[Array, "*batch"]  # [m] least distance of arm or paddle to the table; not above 0: contact
    own_gap: Float[Array, "*batch"]  # [m] of the robot to itself
    blade_gap: Float[Array, "*batch"]  # [m] of the blade to the table


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PlayedBall:
    """One ball once all is over. SI units, the batch last."""

    hit: Bool[Array, "*batch"]  # touched after its bounce
    crossed: Bool[Array, "*batch"]  # flew over the net plane after the hit
    returned: Bool[Array, "*batch"]  # and landed on the human's half
    net_height: Float[Array, "*batch"]  # [m] of its centre over the net plane where it crossed
    landing: Float[Array, "2 *batch"]  # [m] x, y where it came down to the table's height
    closest: Float[Array, "*batch"]  # [m] least distance of ball and blade centre after the bounce
    steps: Float[Array, "*batch"]  # control steps under the policy
    peak_velocity: Float[Array, "joints *batch"]  # [m/s, rad/s] highest commanded speeds


@dataclass(frozen=True, eq=False)
class Term:
    """A reward term: a function of ``ControlStep`` (per "step") or of ``PlayedBall`` (per "ball")."""

    name: str
    per: Literal["step", "ball"]
    function: Callable[[Any], Array]


@dataclass(frozen=True, eq=False)
class Network:
    """A network in streaming form, for one policy and one robot; training runs many of both side by side.

    shapes  of its parameters by name, in the order in which they stand in theta
    start   parameters, first normalised observation (11,) -> state: a pytree of arrays, () for none
    step    parameters, state, normalised observation (11,) -> action (8,), cut to [-1, 1], and the next state
    source  the file that defines it
    """

    name: str
    shapes: dict[str, tuple[int, ...]]
    start: Callable[[Parameters, Array], State]
    step: Callable[[Parameters, State, Array], tuple[Array, State]]
    source: str = ""

    @property
    def size(self) -> int:
        return sum(int(np.prod(shape)) for shape in self.shapes.values())

    def unflatten(self, theta: Any) -> dict[str, Any]:
        """Parameters by name from theta (size, ...)."""
        return unflatten(theta, self.shapes)


@dataclass(frozen=True)
class Definitions:
    """All that one file defines, by name."""

    terms: dict[str, Term] = field(default_factory=dict)
    networks: dict[str, Network] = field(default_factory=dict)


_open: ContextVar[Definitions | None] = ContextVar("definitions", default=None)
_loaded: dict[tuple[str, Contract], Definitions] = {}  # by the file's text and the robot


def reward_term(name: str, per: Literal["step", "ball"] = "step") -> Callable[[F], F]:
    """Registers a reward term under a name that an experiment may weigh: ``rewards: {own: {NAME: 0.5}}``."""

    def register(function: F) -> F:
        if per not in ("step", "ball"):
            raise ValueError(f"reward term {name!r}: per is {per!r}, allowed: step, ball")
        _add(name, "reward term", lambda to: to.terms, Term(name, per, function), rewards.TERMS)
        return function

    return register


def network(name: str, shapes: Mapping[str, tuple[int, ...]]) -> Callable[[type], type]:
    """Registers a class whose static methods ``start`` and ``step`` are a network; see ``Network``."""

    def register(defined: type) -> type:
        missing = [part for part in ("start", "step") if not callable(getattr(defined, part, None))]
        if missing:
            raise ValueError(f"network {name!r}: has no {' and no '.join(missing)}")
        _add(name, "network", lambda to: to.networks, Network(name, dict(shapes), defined.start, defined.step), ())  # type: ignore[attr-defined]
        return defined

    return register


def _add(name: str, what: str, place: Callable[[Definitions], dict], value: Any, taken: tuple[str, ...]) -> None:
    if not (isinstance(name, str) and name.isidentifier()):
        raise ValueError(f"{what} {name!r}: the name must be letters, digits and underscores, such as calm_wrist")
    if name in taken:
        raise ValueError(f"{what} {name!r}: this is one of the package's own: {', '.join(taken)}")
    collecting = _open.get()
    if collecting is None:  # the file is imported by somebody else, a test perhaps
        return
    if name in place(collecting):
        raise ValueError(f"{what} {name!r}: defined twice")
    place(collecting)[name] = value


def load(text: str, where: str, contract: Contract = PAPER) -> Definitions:
    """The definitions in the text of a Python file; runs it. ``where`` names it in errors and tracebacks.

    The same text gives the same objects, so that what was compiled with them is found again. Raises ValueError naming
    the file, the line and what is wrong: with the file itself, or with what a function returns in a trial call.
    """
    if (text, contract) in _loaded:
        return _loaded[text, contract]
    linecache.cache[where] = (len(text), None, text.splitlines(keepends=True), where)
    found = Definitions()
    with _collecting(found), _blamed(where, where):
        exec(compile(text, where, "exec", dont_inherit=True), {"__name__": "definitions", "__file__": where})
    if not found.terms and not found.networks:
        raise ValueError(f"{where}: defines nothing; @reward_term or @network of mjx_tt.env.own before a function does")
    for term in found.terms.values():
        with _blamed(f"{where}: reward term {term.name!r}", where):
            _check_term(term, contract)
    for name, one in found.networks.items():
        one = found.networks[name] = replace(one, source=text)
        with _blamed(f"{where}: network {one.name!r}", where):
            _check_network(one, contract)
    _loaded[text, contract] = found
    return found


def simulated(policy: Policy, where: str, contract: Contract = PAPER) -> Policy:
    """The policy of an artefact for the simulator, which runs the Python of a user's network. Raises ValueError."""
    if policy.network is None or isinstance(policy.network, Network):
        return policy
    defined = load(policy.network.source, f"{where}: network.py", contract).networks
    return replace(policy, network=defined[policy.network.name])


@contextmanager
def _collecting(definitions: Definitions) -> Iterator[None]:
    token = _open.set(definitions)
    try:
        yield
    finally:
        _open.reset(token)


@contextmanager
def _blamed(what: str, file: str) -> Iterator[None]:
    """Any error of the user's code as ValueError with the line of that file where it arose."""
    try:
        yield
    except SyntaxError as error:
        raise ValueError(f"{what}: line {error.lineno}: {error.msg}") from None
    except Exception as error:
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        place = f" line {lines[-1]}:" if lines else ""
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        raise ValueError(f"{what}:{place} {kind}{str(error).splitlines()[0] if str(error) else ''}") from error


def _check_term(term: Term, contract: Contract) -> None:
    def number(*leading: int) -> Any:
        return jax.ShapeDtypeStruct((*leading, *BATCH), jnp.float32)

    flag: Any = jax.ShapeDtypeStruct(BATCH, bool)
    joints, vector = number(contract.n_joints), number(3)
    blade = PaddlePose(vector, vector, vector, vector)
    gaps = number(), number(), number()
    step = ControlStep(number(contract.n_observation), joints, joints, joints, blade, vector, vector, flag, *gaps)
    ball = PlayedBall(flag, flag, flag, number(), number(2), number(), number(), joints)
    found = jax.eval_shape(lambda given: jnp.asarray(term.function(given)), step if term.per == "step" else ball)
    if found.shape not in (BATCH, ()):
        raise ValueError(
            f"returns an array {found.shape} for a batch of {BATCH}: one number an episode is wanted, such as "
            "step.command[7] or jnp.sum(step.command ** 2, axis=0)"
        )
    if jnp.issubdtype(found.dtype, jnp.complexfloating):
        raise ValueError("returns complex numbers")


def _check_network(network: Network, contract: Contract) -> None:
    bad = {
        name: shape
        for name, shape in network.shapes.items()
        if not (isinstance(shape, tuple) and shape and all(isinstance(n, int) and n > 0 for n in shape))
    }
    if bad or not network.shapes:
        raise ValueError(f"shapes are {network.shapes}: tuples of positive whole numbers by name are wanted")

    def called(theta: Array, x: Array) -> tuple[Array, State, State]:
        parameters = network.unflatten(theta)
        state = jax.tree.map(jnp.asarray, network.start(parameters, x))
        action, after = network.step(parameters, state, x)
        return jnp.asarray(action), state, jax.tree.map(jnp.asarray, after)

    numbers = [jax.ShapeDtypeStruct((n,), jnp.float32) for n in (network.size, contract.n_observation)]
    action, before, after = jax.eval_shape(called, *numbers)
    if action.shape != (contract.n_joints,):
        raise ValueError(f"step returns an action {action.shape}, ({contract.n_joints},) is wanted")
    kinds: list[Any] = [jax.tree.structure(state) for state in (before, after)]
    if kinds[0] != kinds[1] or any(
        a.shape != b.shape or a.dtype != b.dtype
        for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True)
    ):
        raise ValueError(f"step returns another kind of state than start does: {after} instead of {before}")
