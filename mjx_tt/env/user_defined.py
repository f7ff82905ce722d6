"""Terms and networks of the user's own, from a Python file that an experiment's key ``definitions`` names.

docs/how-to/define-a-task.md has a complete example.
"""

from __future__ import annotations

import linecache
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from ballmodel.flight import PaddlePose
from mjx_tt.env.reward_weights import TERMS
from mjx_tt.env.terms import ControlStep, ObservationTerm, PlayedBall, RewardTerm, Sensed
from mjx_tt.env.user_network import Network, check_network
from robot_io.contract import CONTROL_RATE, PAPER, Contract
from robot_io.policy.policy import Policy

BATCH = (2, 3)  # of the trial calls that check what a user's function returns
D = TypeVar("D", RewardTerm, ObservationTerm, Network)


@dataclass(frozen=True)
class Definitions:
    """All that one file defines, by name; ``where`` names the file, ``contract`` the robot that it is for."""

    rewards: dict[str, RewardTerm] = field(default_factory=dict)
    observations: dict[str, ObservationTerm] = field(default_factory=dict)
    networks: dict[str, Network] = field(default_factory=dict)
    where: str = ""
    contract: Contract = PAPER

    def checked_network(self, name: str, n_observation: int) -> Network:
        """The network of that name after a trial call. Raises ValueError naming the file and the line."""
        network = self.networks[name]
        with _locate_error(f"{self.where}: network {name!r}", self.where):
            check_network(network, n_observation, self.contract.n_joints)
        return network


_loaded: dict[tuple[str, Contract], Definitions] = {}  # by the file's text and the robot


def load(text: str, where: str, contract: Contract = PAPER) -> Definitions:
    """The definitions in the text of a Python file; runs it. ``where`` names it in errors and tracebacks.

    The same text gives the same objects, so that what was compiled with them is found again. Raises ValueError naming
    the file, the line and what is wrong: with the file itself, or with what a function returns in a trial call.
    """
    if (text, contract) in _loaded:
        return _loaded[text, contract]
    linecache.cache[where] = (len(text), None, text.splitlines(keepends=True), where)
    names: dict[str, Any] = {"__name__": "definitions", "__file__": where}
    with _locate_error(where, where):
        exec(compile(text, where, "exec", dont_inherit=True), names)
        found = Definitions(
            rewards=_collect(names.values(), RewardTerm, TERMS),
            observations=_collect(names.values(), ObservationTerm, contract.observation_names),
            networks={
                name: replace(network, source=text) for name, network in _collect(names.values(), Network).items()
            },
            where=where,
            contract=contract,
        )
    if not (found.rewards or found.observations or found.networks):
        raise ValueError(
            f"{where}: defines nothing; put @reward_term, @observation_term or @network of mjx_tt before a function"
        )
    for reward in found.rewards.values():
        with _locate_error(f"{where}: reward term {reward.name!r}", where):
            _check_reward(reward, contract)
    for observation in found.observations.values():
        with _locate_error(f"{where}: observation term {observation.name!r}", where):
            count_rows((observation,), contract)
    _loaded[text, contract] = found
    return found


def load_network(policy: Policy, where: str, contract: Contract = PAPER) -> Policy:
    """The policy of an artefact for the simulator, which runs the Python of a user's network. Raises ValueError."""
    if policy.network is None or isinstance(policy.network, Network):
        return policy
    defined = load(policy.network.source, f"{where}: network.py", contract)
    return replace(policy, network=defined.checked_network(policy.network.name, policy.n_observation))


def count_rows(terms: Iterable[ObservationTerm], contract: Contract) -> int:
    """Rows that observation terms give together, of a robot. Raises ValueError for a term that gives no rows."""
    sensed = Sensed(_shape(3), _shape(contract.n_joints), _shape(contract.n_joints))
    count = 0
    for term in terms:
        found = jax.eval_shape(term, sensed)
        if found.ndim != 1 + len(BATCH) or found.shape[1:] != BATCH or not jnp.issubdtype(found.dtype, jnp.floating):
            raise ValueError(
                f"returns {found.dtype} {found.shape} for a batch of {BATCH}: rows of numbers (k, *batch) are wanted, "
                "such as sensed.command or sensed.ball[:1]"
            )
        count += found.shape[0]
    return count


def _collect(values: Iterable[Any], kind: type[D], taken: tuple[str, ...] = ()) -> dict[str, D]:
    """The objects of a kind by their names."""
    found: dict[str, D] = {}
    for one in {id(value): value for value in values if isinstance(value, kind)}.values():
        if one.name in taken:
            raise ValueError(f"{one.name!r}: the name is one of the package's own: {', '.join(taken)}")
        if one.name in found:
            raise ValueError(f"{one.name!r}: defined twice")
        found[one.name] = one
    return found


@contextmanager
def _locate_error(what: str, file: str) -> Iterator[None]:
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


def _shape(*leading: int, dtype: Any = jnp.float32) -> Any:
    return jax.ShapeDtypeStruct((*leading, *BATCH), dtype)


def _check_reward(term: RewardTerm, contract: Contract) -> None:
    flag, number, vector, joints = _shape(dtype=bool), _shape(), _shape(3), _shape(contract.n_joints)
    given: ControlStep | PlayedBall
    if term.per == "step":
        # Further observation terms have rows of their own after the contract's.
        observation, blade = _shape(contract.n_observation), PaddlePose(vector, vector, vector, vector)
        motion, gaps = (joints, joints, joints, joints, blade, vector, vector, flag), (number, number, number)
        given = ControlStep(observation, *motion, *gaps, contract.limits, 1.0 / CONTROL_RATE)
    else:
        given = PlayedBall(flag, flag, flag, number, _shape(2), number, number, joints, flag)
    found = jax.eval_shape(lambda given: jnp.asarray(term(given)), given)
    if found.shape not in (BATCH, ()):
        raise ValueError(
            f"returns an array {found.shape} for a batch of {BATCH}: one number an episode is wanted, such as "
            "step.command[7] or jnp.sum(step.command ** 2, axis=0)"
        )
    if jnp.issubdtype(found.dtype, jnp.complexfloating):
        raise ValueError("returns complex numbers")
