"""Process-wide settings of JAX that have to be in place before it starts. Imports nothing heavy."""

from __future__ import annotations

import os
from pathlib import Path

# XLA's CPU pipeline throws optimisation barriers away before it fuses. Keeping them lets ``fold.materialise`` stop the
# compiler from computing shared terms again in every fusion: 3 x the speed of the arm's dynamics. Unknown names are
# ignored, so a future release that renames the pass loses the speed and nothing else.
# (XLA's optional multi-output fusion, xla_cpu_use_multi_output_fusion, would bring a fifth more, but in jaxlib 0.10 it
# aborts the process while compiling MJX.)
_XLA_FLAGS = ("--xla_disable_hlo_passes=cse_barrier_expander",)


def configure(devices: int | None = None, cache: str | os.PathLike | None = None) -> None:
    """Sets XLA's flags, one host device per processor core (or ``devices``) and the persistent compilation cache.

    Call it before the first use of JAX in the process. QR on many threads stalls on small machines, so the BLAS that
    LAPACK calls is kept to one.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    flags = os.environ.get("XLA_FLAGS", "").split()
    os.environ["XLA_FLAGS"] = " ".join(flags + [flag for flag in _XLA_FLAGS if flag not in flags])
    import jax

    jax.config.update("jax_num_cpu_devices", devices or len(os.sched_getaffinity(0)))
    directory = Path(cache or os.environ.get("JAX_COMPILATION_CACHE_DIR") or Path.home() / ".cache" / "mjx-tt" / "xla")
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
