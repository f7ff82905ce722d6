"""Process-wide settings of JAX that have to be in place before it starts. Imports nothing heavy."""

from __future__ import annotations

import os
from importlib import metadata, util
from pathlib import Path

# XLA's CPU pipeline throws optimisation barriers away before it fuses. Keeping them lets ``optimization_barrier`` stop
# the compiler from computing shared terms again in every fusion: 3 x the speed of the arm's dynamics. Unknown names are
# ignored, so a future release that renames the pass loses the speed and nothing else. XLA's compilers for accelerators
# cannot do without the pass.
# (XLA's optional multi-output fusion, xla_cpu_use_multi_output_fusion, would bring a fifth more, but in jaxlib 0.10 it
# aborts the process while compiling MJX.)
_XLA_FLAGS = ("--xla_disable_hlo_passes=cse_barrier_expander",)


def configure(devices: int | None = None, cache: str | os.PathLike | None = None) -> None:
    """Sets XLA's flags, one host device per processor core (or ``devices``) and the persistent compilation cache.

    Call it before the first use of JAX in the process. QR on many threads stalls on small machines, so the BLAS that
    LAPACK calls is kept to one.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if not _accelerated():
        flags = os.environ.get("XLA_FLAGS", "").split()
        os.environ["XLA_FLAGS"] = " ".join(flags + [flag for flag in _XLA_FLAGS if flag not in flags])
    import jax

    jax.config.update("jax_num_cpu_devices", devices or len(os.sched_getaffinity(0)))
    directory = Path(cache or os.environ.get("JAX_COMPILATION_CACHE_DIR") or Path.home() / ".cache" / "mjx-tt" / "xla")
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def older_fusion() -> bool:
    """True where XLA still has its older code generation for fused operations on processors: before jaxlib 0.11, which
    ends the process for a flag that it does not know."""
    major, minor = metadata.version("jaxlib").split(".")[:2]
    return (int(major), int(minor)) < (0, 11)


def _accelerated() -> bool:
    """True where JAX may find an accelerator: one of its plug-ins is installed, and JAX_PLATFORMS allows it.

    JAX itself would have to be started to know.
    """
    allowed = os.environ.get("JAX_PLATFORMS", "")
    if allowed.split(",")[0] == "cpu":
        return False
    return bool(metadata.entry_points(group="jax_plugins")) or util.find_spec("libtpu") is not None
