"""The policy for the control loop: compiled by JAX where that is fast enough, else by NumPy, which is always there."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from robot_io import contract
from robot_io.policy.numpy_policy import StreamingPolicy
from robot_io.policy.policy import LoopPolicy, Policy

TRIALS = 300  # steps of each that are timed, after as many that are not
SLOWER = 0.2e-3  # [s] by which nine of ten of JAX's steps may take longer than NumPy's: 1.5 % of a control period


def make_policy(backend: str, policy: Policy, robot: contract.Contract = contract.PAPER) -> LoopPolicy:
    """A policy for the loop, by "numpy" or "jit". Raises ValueError for another backend."""
    if policy.network is not None and backend != "jit":
        raise ValueError(f"policy backend {backend!r}: the network {policy.network.name!r} is computed by jit only")
    if backend == "numpy":
        return StreamingPolicy(policy, robot)
    if backend == "jit":
        from robot_io.policy import jax_policy  # imports JAX

        return (jax_policy.JitPolicy if policy.network is None else jax_policy.ExportedPolicy)(policy, robot)
    raise ValueError(f"policy backend {backend!r}, allowed: numpy, jit")


def choose(backend: str, policy: Policy, robot: contract.Contract = contract.PAPER) -> tuple[str, str]:
    """The backend that computes the policy, "numpy" or "jit", and a sentence for the log.

    "auto" takes JAX unless it cannot be used here or is slower (``SLOWER``). Takes some seconds for JAX to start.
    """
    if backend == "auto" and policy.network is not None:
        return "jit", f"policy compiled by JAX: its network is {policy.network.name!r}"
    if backend != "auto":
        return backend, f"policy computed by {backend}, as chosen"
    try:
        compiled = _slow_step(make_policy("jit", policy, robot), robot)
    except Exception as error:  # a missing or broken JAX, whatever it raises, must not keep the robot from playing
        return "numpy", f"policy computed by NumPy: JAX cannot be used here ({type(error).__name__}: {error})"
    plain = _slow_step(make_policy("numpy", policy, robot), robot)
    times = f"90 % of steps within {1e3 * compiled:.3f} ms, by NumPy {1e3 * plain:.3f} ms"
    if compiled > plain + SLOWER:
        return "numpy", f"policy computed by NumPy: JAX is slower here ({times})"
    return "jit", f"policy compiled by JAX ({times})"


def _slow_step(policy: LoopPolicy, robot: contract.Contract) -> float:
    """Time [s] within which 90 % of the steps are done; what is slower is the machine's load."""
    observations = np.random.default_rng(0).normal(0.0, 0.5, (2 * TRIALS, robot.n_observation))
    seconds = []
    for observation in observations:
        began = perf_counter()
        policy.step(observation)
        seconds.append(perf_counter() - began)
    return float(np.quantile(seconds[TRIALS:], 0.9))
