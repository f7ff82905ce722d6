"""Step the task as a brax environment, compiled and batched, and as a vectorised one of Gymnasium."""

import brax.envs
import gymnasium  # pip install "mjx-tt[gymnasium]"
import jax
import jax.numpy as jnp

import mjx_tt
import mjx_tt.env.gymnasium  # registers; not needed where the package is installed

mjx_tt.configure()
env = brax.envs.get_environment("table_tennis", balls="narrow")
state = jax.jit(env.reset)(jax.random.split(jax.random.key(0), 256))
step = jax.jit(env.step)
for _ in range(75):  # one second
    state = step(state, jnp.zeros((256, env.action_size)))
print("brax:", state.obs.shape, "mean reward of the last step", state.reward.mean())

envs = gymnasium.make_vec("mjx_tt/TableTennis-v0", num_envs=64, balls="narrow")
observation, _ = envs.reset(seed=0)
for _ in range(75):
    observation, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
print("Gymnasium:", observation.shape, "mean reward of the last step", reward.mean())
