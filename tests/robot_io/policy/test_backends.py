"""Backends of the policy in the control loop: JAX or NumPy."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from robot_io import contract
from robot_io.policy import backends, jax_policy
from robot_io.policy.backends import choose, make_policy
from robot_io.policy.jax_policy import JitPolicy
from robot_io.policy.numpy_policy import StreamingPolicy
from robot_io.policy.policy import Policy
from tests.support.paths import ROOT

RANDOM = np.random.default_rng(2)


def drawn() -> Policy:
    return Policy(RANDOM.normal(0.0, 0.5, contract.n_parameters()), RANDOM.normal(size=11), np.ones(11))


def test_jax_is_the_default_unless_it_is_slower(monkeypatch):
    monkeypatch.setattr(backends, "SLOWER", np.inf)  # however busy this machine is
    backend, sentence = choose("auto", drawn())
    assert backend == "jit" and "compiled by JAX" in sentence and "by NumPy" in sentence
    monkeypatch.setattr(backends, "SLOWER", -1.0)
    backend, sentence = choose("auto", drawn())
    assert backend == "numpy" and "JAX is slower here" in sentence
    assert choose("numpy", drawn())[0] == "numpy" and choose("jit", drawn())[0] == "jit"
    with pytest.raises(ValueError, match="allowed: numpy, jit"):
        make_policy("tpu", drawn())


def test_without_jax_numpy_computes_the_policy_and_says_so():
    code = """
import sys
sys.modules["jax"] = None  # as where it is not installed
import numpy as np
from robot_io import contract
from robot_io.policy.backends import choose, make_policy
from robot_io.policy.policy import Policy
policy = Policy(np.zeros(contract.n_parameters()), np.zeros(11), np.ones(11))
backend, sentence = choose("auto", policy)
print(sentence)
make_policy(backend, policy).step(np.zeros(11))
import robot_io.control.process
sys.exit(backend != "numpy" or any(name.startswith("jax.") for name in sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "policy computed by NumPy: JAX cannot be used here" in done.stdout


def test_both_compute_the_same_and_another_policy_does_not_compile_again():
    make_policy("jit", drawn())
    policy, before = drawn(), jax_policy.jitted_forward._cache_size()
    compiled = make_policy("jit", policy)
    assert jax_policy.jitted_forward._cache_size() == before  # between two balls of a fine-tuning, in the control loop
    plain = make_policy("numpy", policy)
    assert isinstance(compiled, JitPolicy) and isinstance(plain, StreamingPolicy)
    for observation in RANDOM.normal(size=(12, 11)):
        np.testing.assert_allclose(compiled.step(observation), plain.step(observation), atol=2e-5)
