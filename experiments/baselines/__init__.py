"""Algorithms of other kinds on the task of a training, and their comparison."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):  # brax imports MJX, which prints that Warp is absent
    import brax.envs.base  # noqa: F401
