"""Settings that have to be in place before JAX starts, for every test and for every process that a test starts."""

from __future__ import annotations

import gc
import os
import signal
from pathlib import Path

import pytest

from mjx_tt import platform

# Started in the background (nohup, &) the tests ignore Ctrl-C, and so would their processes: one that is sent it would
# never end.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Tests compile far more than they compute: without LLVM's optimisation a program compiles in half the time. Set to 0,
# the tests run the programs that users get, as those marked ``optimised`` do, in which computing is most of the work.
UNOPTIMISED = os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1") == "1"
# And with XLA's older code generation for fused operations in a third of that. Its rounding depends on how many
# episodes a device holds: the slow tests that compare studies of several processes bit by bit take the code that users
# get, which unoptimised is too slow for MJX.
if UNOPTIMISED and os.environ.get("USERS_FUSION", "0") != "1" and platform.older_fusion():
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_use_fusion_emitters=false".strip()
# The tests run beside each other on every core: what XLA spreads over threads to compile would only cost more.
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_parallel_codegen_split_count=1".strip()
CACHE = Path(__file__).parent.parent / ".cache" / "jax"
# Compiled programs are kept between runs and shared with the other workers and with started processes.
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(CACHE)

import jax  # noqa: E402 - reads the environment
from jaxtyping import install_import_hook  # noqa: E402

import tests.support.type_checker  # noqa: E402, F401 - found by its name
from tests.support.durations import mark_deferred  # noqa: E402
from tests.support.machine_watch import rerun_after_pauses, watched_machine  # noqa: E402, F401 - for pytest

# STRICT_ARRAYS=1: annotations of functions are checked, arrays by type and shape, in every call (of compiled functions:
# when they are traced); numbers change their type and arrays their rank only where the code says so.
STRICT = os.environ.get("STRICT_ARRAYS", "0") == "1"
if STRICT:  # the hook works on modules that are imported after it
    install_import_hook(("ballmodel", "bgs", "mjx_tt"), "tests.support.type_checker.checked")

# Two host devices, so that splitting over devices is tested everywhere.
platform.configure(devices=2, cache=CACHE)
jax.devices()  # from here on no command in this process can change their number

from mjx_tt.env import evaluator  # noqa: E402

USERS_COLUMNS = evaluator.COLUMNS
if STRICT:
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    mark_deferred(items)
    rerun_after_pauses(items)


def pytest_collection_finish() -> None:
    gc.freeze()  # what was imported stays: garbage is sought among what the tests make


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    optimised = item.get_closest_marker("optimised") is not None
    jax.config.update("jax_disable_most_optimizations", UNOPTIMISED and not optimised)
    # Evaluations of a few episodes are padded to an eighth of what users get; slow tests compare them with those of
    # other processes.
    evaluator.COLUMNS = USERS_COLUMNS if item.get_closest_marker("slow") else USERS_COLUMNS // 8
