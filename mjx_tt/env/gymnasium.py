"""The task for Gymnasium: ``gymnasium.make_vec("mjx_tt/TableTennis-v0", num_envs=64)``, or ``make`` for single balls.

Importing this module registers it; an installed package is registered by its entry point. Keyword arguments are those
of ``mjx_tt.make``. Needs the extra ``gymnasium``.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mjx_tt.env.make import make

ID = "mjx_tt/TableTennis-v0"


class TableTennisVectorEnv(VectorEnv):
    """``num_envs`` balls side by side in one compiled step.

    Observation (n, 88): the last eight of the contract, oldest first. Action (n, 8) in [-1, 1]. An episode that ends is
    followed within the same step by one with a fresh ball; ``info`` then holds "hit", "returned" and "episode_return",
    (n,) each, of the episodes that ended. Nothing is ever truncated.
    """

    def __init__(self, num_envs: int = 1, **options: Any) -> None:
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        self.num_envs = num_envs
        env = make(**options)
        self.single_observation_space = Box(-np.inf, np.inf, (env.observation_size,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (env.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._reset, self._step = jax.jit(env.reset), jax.jit(env.step)
        self._state: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Fresh balls for all; the same seed gives the same balls."""
        super().reset(seed=seed)
        if isinstance(seed, list):
            raise ValueError(f"seed is {seed!r}: one whole number draws the balls of all environments")
        chosen = int(self.np_random.integers(2**31)) if seed is None else seed
        self._state = self._reset(jax.random.split(jax.random.key(chosen), self.num_envs))
        return np.asarray(self._state.obs), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control period. Raises ValueError for actions of another shape, RuntimeError before ``reset``."""
        if self._state is None:
            raise RuntimeError("step before reset")
        actions = np.asarray(actions, np.float32)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions have shape {actions.shape}, wanted is {self.action_space.shape}")
        self._state = state = self._step(self._state, actions)
        done = np.asarray(state.done) > 0
        info = (
            {name: np.asarray(value) for name, value in state.metrics.items()} | {"_episode": done}
            if done.any()
            else {}
        )
        return np.asarray(state.obs), np.asarray(state.reward), done, np.zeros_like(done), info


class TableTennisEnv(gymnasium.Env):
    """One ball at a time."""

    def __init__(self, **options: Any) -> None:
        self._balls = TableTennisVectorEnv(1, **options)
        self.observation_space = self._balls.single_observation_space
        self.action_space = self._balls.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A fresh ball."""
        super().reset(seed=seed)
        observation, info = self._balls.reset(seed=seed)
        return observation[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control period; ``info`` of the last one holds "hit", "returned" and "episode_return"."""
        observation, reward, done, truncated, info = self._balls.step(np.asarray(action)[None])
        outcome = {name: value[0].item() for name, value in info.items() if not name.startswith("_")}
        return observation[0], float(reward[0]), bool(done[0]), bool(truncated[0]), outcome


def register() -> None:
    """Makes the environments known to Gymnasium."""
    if ID not in gymnasium.registry:
        gymnasium.register(ID, entry_point=TableTennisEnv, vector_entry_point=TableTennisVectorEnv)


register()
