"""Settings that have to be in place before JAX starts, for every test and for every process that a test starts."""

from __future__ import annotations

import os
from pathlib import Path

from mjx_tt import platform

CACHE = Path(__file__).parent.parent / ".cache" / "jax"
# Tests compile far more than they compute: without LLVM's optimisation a program compiles in half the time. A set
# XLA_FLAGS is left as it is, so XLA_FLAGS="" runs the tests on the programs that users get.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true")
# Compiled programs are kept between runs and shared with the other workers and with started processes.
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(CACHE)
# Two host devices, so that splitting over devices is tested everywhere.
platform.configure(devices=2, cache=CACHE)
