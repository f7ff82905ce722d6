"""OpenGL without a display.

The back end is the one that MUJOCO_GL names (egl, osmesa, glfw or cgl), or else the first that works of those usual on
this system. It is chosen when the first picture is made, so it does not matter when MuJoCo was imported.
"""

from __future__ import annotations

import importlib
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import mujoco

_BACKENDS = {"Linux": ("egl", "osmesa"), "Darwin": ("cgl",), "Windows": ("glfw",)}
_KNOWN_BACKENDS = ("egl", "osmesa", "glfw", "cgl")


@contextmanager
def offscreen(model: mujoco.MjModel, size: tuple[int, int]) -> Iterator[mujoco.MjrContext]:
    """A current OpenGL context of this size with the model's meshes and textures; freed on exit."""
    chosen = backend()
    try:
        gl = importlib.import_module(f"mujoco.{chosen}").GLContext(*size)
        gl.make_current()
    except Exception as error:  # PyOpenGL raises whatever its failed look-up happens to hit
        raise RuntimeError(_no_backend((chosen,))) from error
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    try:
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        yield context
    finally:
        context.free()
        gl.free()


@cache
def backend() -> str:
    """MUJOCO_GL, or else the first of this system's back ends that makes a context.

    A back end is tried in a process of its own: PyOpenGL binds to one for the life of a process, even when it fails.
    """
    asked = os.environ.get("MUJOCO_GL", "").strip().lower()
    if asked in _KNOWN_BACKENDS:
        return asked
    if asked:
        raise RuntimeError(f"MUJOCO_GL={asked!r} cannot render without a display; use one of {_KNOWN_BACKENDS}")
    candidates = _BACKENDS.get(platform.system(), ("glfw",))
    for name in candidates:
        attempt = f"from mujoco.{name} import GLContext; GLContext(8, 8).make_current()"
        if len(candidates) == 1 or not subprocess.run([sys.executable, "-c", attempt], capture_output=True).returncode:
            return name
    raise RuntimeError(_no_backend(candidates))


def _no_backend(tried: tuple[str, ...]) -> str:
    return (
        f"no OpenGL back end for rendering without a display: tried {', '.join(tried)}. On Debian or Ubuntu install "
        "EGL (apt-get install libegl1 libgl1 libgl1-mesa-dri) or OSMesa (apt-get install libosmesa6)"
    )
