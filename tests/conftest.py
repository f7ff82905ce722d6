"""Settings that have to be in place before JAX starts, for every test and for every process that a test starts."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# Tests compile far more than they compute: without LLVM's optimisation a program compiles in half the time. Set to 0,
# the tests run the programs that users get, as those marked ``optimised`` do, in which computing is most of the work.
UNOPTIMISED = os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1") == "1"
CACHE = Path(__file__).parent.parent / ".cache" / "jax"
# Compiled programs are kept between runs and shared with the other workers and with started processes.
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(CACHE)

import jax  # noqa: E402 - reads the environment

from mjx_tt import platform  # noqa: E402

# Two host devices, so that splitting over devices is tested everywhere.
platform.configure(devices=2, cache=CACHE)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    optimised = item.get_closest_marker("optimised") is not None
    jax.config.update("jax_disable_most_optimizations", UNOPTIMISED and not optimised)
