"""A policy on many balls, each played once, whatever their number with one compiled program."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from ballmodel.sampling import BallPool
from ballmodel.state import BallState
from mjx_tt.env.policy import Policy
from mjx_tt.env.rollout import RESULT_SPECS, RolloutResult, Simulator
from mjx_tt.sim.model import SimModel
from mjx_tt.sim.randomisation import Randomised

ROWS, COLUMNS = 8, 256  # episodes of one call: fewer are padded, more take several calls


class Evaluator:
    """Plays one policy at a time on the balls of a pool, each of them once. Compiles once, whatever their number.

    simulator  its devices share the columns
    balls      n of them; the result keeps them in the order of their arrival, ``order`` (n,) gives their places in it
    model, randomise  the world, and what is drawn around it

    Drawing every ball once keeps the episodes independent, which the interval of a rate relies on.
    """

    def __init__(
        self, simulator: Simulator, balls: BallPool, model: SimModel, randomise: tuple[Randomised, ...]
    ) -> None:
        columns = self._columns = -(-COLUMNS // simulator.devices) * simulator.devices

        def play(policy: Policy, key: PRNGKeyArray, pool: BallPool, thrown: BallState) -> RolloutResult:
            # Each thrown ball has the spin that it was drawn with, and one of the model beside it, not another ball's.
            drawn = simulator.draw(key, pool.without_spin(), model, randomise, ROWS, columns)
            copies = jnp.repeat(policy.theta[:, None], columns // simulator.devices, axis=1)
            spinning = replace(thrown, spin=thrown.spin + drawn.ball.spin)
            return simulator.rollout(replace(policy, theta=copies), simulator.local(replace(drawn, ball=spinning)))

        self._traced = jax.jit(simulator.on_devices(play, out_specs=RESULT_SPECS))
        self._spread: Callable[..., RolloutResult] = self._traced
        self._replicate, self._gather = simulator.replicate, simulator.gather
        self._set(balls)

    def on(self, balls: BallPool) -> Evaluator:
        """The same on other balls, with this one's compiled program."""
        other = copy(self)
        other._set(balls)
        return other

    def _set(self, balls: BallPool) -> None:
        self.count = balls.arrival.shape[0]
        # Balls of similar arrival in one row: rows run together until their last episode ends.
        self.order = np.argsort(np.asarray(balls.arrival))
        padded = np.resize(self.order, -(-self.count // (ROWS * self._columns)) * ROWS * self._columns)
        padded[self.count :] = self.order[-1]
        self._calls = [
            (
                replace(
                    balls, state=_take(balls.state, flat), arrival=balls.arrival[flat], landing=balls.landing[:, flat]
                ),
                _take(balls.state, flat.reshape(ROWS, self._columns)),
            )
            for flat in padded.reshape(-1, ROWS * self._columns)
        ]

    def compile(self, policy: Policy, key: PRNGKeyArray) -> None:
        """Compiles ``play`` for policies like this one; otherwise its first call does."""
        self._spread = self._traced.lower(*self._replicate((policy, key, *self._calls[0]))).compile()

    def play(self, policy: Policy, key: PRNGKeyArray) -> RolloutResult:
        """The episodes under the key of latencies and noise, NumPy arrays (..., n); without observation statistics."""
        found = []
        for i, call in enumerate(self._calls):
            # One layout for arrays from training and from files: one compilation.
            arguments = self._replicate((policy, key if i == 0 else jax.random.fold_in(key, i), *call))
            found.append(self._spread(*arguments))
        per_episode: dict[str, Any] = {
            field.name: np.concatenate(
                [self._gather(x).reshape(*x.shape[:-2], -1) for x in (getattr(f, field.name) for f in found)], axis=-1
            )[..., : self.count]
            for field in fields(RolloutResult)
            if not field.name.startswith("observation")
        }
        return RolloutResult(**per_episode | {"observation_sums": None, "observation_counts": None})


def _take(state: BallState, index: np.ndarray) -> BallState:
    return jax.tree.map(lambda x: x[:, index], state)
