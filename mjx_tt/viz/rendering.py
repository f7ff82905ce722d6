"""Pictures and videos of the table, the robot and the ball, made without a display.

The OpenGL back end is the one that MUJOCO_GL names (egl, osmesa, glfw or cgl), or else the first that works of those
usual on this system. It is chosen when the first picture is made, so it does not matter when MuJoCo was imported.
"""

from __future__ import annotations

import importlib
import math
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import imageio.v2 as imageio
import mujoco
import numpy as np
from PIL import Image

from mjx_tt.robot.model import load_model

VIDEO_SUFFIXES = (".mp4", ".gif")

_BACKENDS = {"Linux": ("egl", "osmesa"), "Darwin": ("cgl",), "Windows": ("glfw",)}
_KNOWN_BACKENDS = ("egl", "osmesa", "glfw", "cgl")
_BALL_GROUP = 0  # the ball's geom group in scene.xml, which holds nothing else
_TRAIL_RADIUS = 0.008  # [m]
_TRAIL_RGB = (1.0, 0.55, 0.1)
_GIF_TICK = 0.01  # [s], the format's unit of time
_GIF_MIN_DELAY = 0.02  # [s], viewers slow down frames that are shorter than this


def render_png(
    path: str | os.PathLike,
    qpos: np.ndarray,
    ball_position: np.ndarray | None = None,
    camera: str = "side",
    size: tuple[int, int] = (960, 540),
    model: mujoco.MjModel | None = None,
) -> None:
    """Writes one picture.

    qpos (8,) [m], [rad]; ball_position (3,) [m] in the world frame, None to leave the ball out; camera: one of
    ``camera_names()``; size: (width, height) in pixels.
    Raises ValueError for a wrong shape, camera or suffix, RuntimeError when no OpenGL back end works.
    """
    path = _checked_path(path, (".png",))
    qpos = _checked_array("qpos", qpos, (None,))[None]
    ball = None if ball_position is None else _checked_array("ball_position", ball_position, (3,))[None]
    (frame,) = render_frames(qpos, ball, camera, size, model=model)
    with _replacing(path) as temporary:
        Image.fromarray(frame).save(temporary)


def render_video(
    path: str | os.PathLike,
    qpos: np.ndarray,
    ball: np.ndarray | None = None,
    fps: float = 75.0,
    camera: str = "side",
    size: tuple[int, int] = (960, 540),
    trail: float = 0.3,
    model: mujoco.MjModel | None = None,
) -> int:
    """Writes a video in real time and returns the number of its frames.

    qpos (T, 8) [m], [rad] and ball (T, 3) [m] sampled at fps; the ball is left out where it is not finite. trail: how
    long the ball's path stays visible [s]. The suffix chooses the format: .mp4 (H.264), or .gif, where frames are left
    out so that each lasts the 0.02 s that viewers honour.
    Raises ValueError for a wrong shape, camera or suffix, RuntimeError when no OpenGL back end works.
    """
    path = _checked_path(path, VIDEO_SUFFIXES)
    if not len(qpos) or not fps > 0:
        raise ValueError(f"a video needs at least one frame and a positive fps, got {len(qpos)} frames at fps {fps}")
    if path.suffix == ".mp4" and (size[0] % 2 or size[1] % 2):
        raise ValueError(f"H.264 needs an even width and height, got {size}")
    stride = max(1, math.ceil(_GIF_MIN_DELAY * fps - 1e-9)) if path.suffix == ".gif" else 1
    frames = render_frames(qpos, ball, camera, size, round(trail * fps), stride, model)
    with _replacing(path) as temporary:
        write = _write_gif if path.suffix == ".gif" else _write_mp4
        return write(temporary, frames, fps / stride)


def render_frames(
    qpos: np.ndarray,
    ball: np.ndarray | None = None,
    camera: str = "side",
    size: tuple[int, int] = (960, 540),
    trail_frames: int = 0,
    stride: int = 1,
    model: mujoco.MjModel | None = None,
) -> Iterator[np.ndarray]:
    """Every stride-th frame of a motion, each (height, width, 3) uint8.

    qpos (T, 8) [m], [rad]; ball (T, 3) [m], left out where not finite; its last trail_frames positions are marked.
    model: a robot at the table; None: the paper's.
    Raises ValueError for a wrong shape or camera, RuntimeError when no OpenGL back end works.
    """
    qpos = _checked_array("qpos", qpos, (None, None))
    ball = None if ball is None else _checked_array("ball", ball, (len(qpos), 3))
    model = load_model() if model is None else model
    if qpos.shape[1] != model.nq:
        raise ValueError(f"qpos needs {model.nq} joint positions, got {qpos.shape[1]}")
    if camera not in (names := camera_names(model)):
        raise ValueError(f"the scene has no camera {camera!r}; it has {names}")
    width, height = size
    if width <= 0 or height <= 0:
        raise ValueError(f"size must be positive, got {size}")
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    data = mujoco.MjData(model)
    scene = mujoco.MjvScene(model, maxgeom=model.ngeom + trail_frames + 10)
    option, view, perturb = mujoco.MjvOption(), mujoco.MjvCamera(), mujoco.MjvPerturb()
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(camera).id
    viewport, pixels = mujoco.MjrRect(0, 0, width, height), np.empty((height, width, 3), np.uint8)
    with _offscreen(model, size) as context:
        for t in range(0, len(qpos), stride):
            data.qpos[:] = qpos[t]
            shown = ball is not None and np.isfinite(ball[t]).all()
            option.geomgroup[_BALL_GROUP] = shown
            if ball is not None and shown:
                data.mocap_pos[0] = ball[t]
            mujoco.mj_forward(model, data)
            mujoco.mjv_updateScene(model, data, option, perturb, view, mujoco.mjtCatBit.mjCAT_ALL, scene)
            if ball is not None:
                _add_trail(scene, ball[max(0, t - trail_frames) : t])
            mujoco.mjr_render(viewport, scene, context)
            mujoco.mjr_readPixels(pixels, None, viewport, context)
            yield pixels[::-1].copy()


def camera_names(model: mujoco.MjModel | None = None) -> list[str]:
    """Names of the cameras of the model, by default the table-tennis scene."""
    model = load_model() if model is None else model
    return [model.camera(i).name for i in range(model.ncam)]


def _write_mp4(path: Path, frames: Iterator[np.ndarray], fps: float) -> int:
    count = 0
    with imageio.get_writer(path, fps=fps, codec="libx264", quality=8, macro_block_size=2) as writer:
        for frame in frames:
            writer.append_data(frame)  # type: ignore[attr-defined]  # annotated as the base of readers and writers
            count += 1
    return count


def _write_gif(path: Path, frames: Iterator[np.ndarray], fps: float) -> int:
    images = [Image.fromarray(frame).quantize(128, dither=Image.Dither.NONE) for frame in frames]
    # Rounding the time of each frame, not its duration, keeps the video in real time.
    times = np.round(np.arange(len(images) + 1) / fps / _GIF_TICK)
    durations = [int(d) for d in np.diff(times) * _GIF_TICK * 1000]
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0)
    return len(images)


def _add_trail(scene: mujoco.MjvScene, past: np.ndarray) -> None:
    """Appends a small sphere for every past ball position (N, 3), oldest first and faintest."""
    for age, position in enumerate(past, start=1):
        if np.isfinite(position).all():
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(
                geom,
                mujoco.mjtGeom.mjGEOM_SPHERE,
                np.full(3, _TRAIL_RADIUS),
                np.asarray(position, float),
                np.eye(3).ravel(),
                np.array([*_TRAIL_RGB, 0.7 * age / len(past)], np.float32),
            )
            geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # casts no shadow
            scene.ngeom += 1


@contextmanager
def _offscreen(model: mujoco.MjModel, size: tuple[int, int]) -> Iterator[mujoco.MjrContext]:
    """A current OpenGL context of this size with the model's meshes and textures; freed on exit."""
    backend = _backend()
    try:
        gl = importlib.import_module(f"mujoco.{backend}").GLContext(*size)
        gl.make_current()
    except Exception as error:  # PyOpenGL raises whatever its failed look-up happens to hit
        raise RuntimeError(_no_backend((backend,))) from error
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    try:
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        yield context
    finally:
        context.free()
        gl.free()


@cache
def _backend() -> str:
    """MUJOCO_GL, or else the first of this system's back ends that makes a context.

    A back end is tried in a process of its own: PyOpenGL binds to one for the life of a process, even when it fails.
    """
    asked = os.environ.get("MUJOCO_GL", "").strip().lower()
    if asked in _KNOWN_BACKENDS:
        return asked
    if asked:
        raise RuntimeError(f"MUJOCO_GL={asked!r} cannot render without a display; use one of {_KNOWN_BACKENDS}")
    candidates = _BACKENDS.get(platform.system(), ("glfw",))
    for backend in candidates:
        attempt = f"from mujoco.{backend} import GLContext; GLContext(8, 8).make_current()"
        if len(candidates) == 1 or not subprocess.run([sys.executable, "-c", attempt], capture_output=True).returncode:
            return backend
    raise RuntimeError(_no_backend(candidates))


def _no_backend(tried: tuple[str, ...]) -> str:
    return (
        f"no OpenGL back end for rendering without a display: tried {', '.join(tried)}. On Debian or Ubuntu install "
        "EGL (apt-get install libegl1 libgl1 libgl1-mesa-dri) or OSMesa (apt-get install libosmesa6)"
    )


def _checked_path(path: str | os.PathLike, suffixes: tuple[str, ...]) -> Path:
    path = Path(path)
    if path.suffix not in suffixes:
        raise ValueError(f"{path}: suffix {path.suffix!r}; allowed: {', '.join(suffixes)}")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: the folder {path.parent} does not exist")
    return path


def _checked_array(name: str, values: np.ndarray, shape: tuple[int | None, ...]) -> np.ndarray:
    """values as float64; ValueError unless it has this shape, None standing for any length."""
    values = np.asarray(values, float)
    if values.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, values.shape, strict=True)):
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f"{name} needs the shape ({wanted}), got {values.shape}")
    return values


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """A temporary file beside path, which replaces path when the block ends without an error."""
    temporary = path.with_name(f".{path.stem}-{os.getpid()}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
