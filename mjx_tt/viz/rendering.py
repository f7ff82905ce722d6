"""Pictures and videos of the table, the robot, the ball and the person's place, made without a display.

A line of text below says which ball it is, what became of it, how fast it was.

Ball and trail are two colours, bright within dark, so that one of them stands out from whatever lies behind: both
rubbers, table, net, floor, sky. The ball is drawn larger than it is.

OpenGL's back end is the one that MUJOCO_GL names (egl, osmesa, glfw or cgl), or else the first that works of those
usual on this system. It is chosen when the first picture is made, so it does not matter when MuJoCo was imported.
"""

from __future__ import annotations

import importlib
import os
import platform
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ballmodel.io.atomic_files import replacing
from mjx_tt.robot.mjcf import load_model

VIDEO_SUFFIXES = (".mp4", ".gif")
CAMERA = "human"
SIZE = (960, 540)

BRIGHT, DARK = (1.0, 0.94, 0.1), (0.02, 0.03, 0.07)
SHOWN_RADIUS, RING_RADIUS = 0.03, 0.042  # [m]; the true ball, of 0.02 m, is a few pixels wide
TRAIL_RADIUS, EDGE = 0.011, 0.007  # [m] at the trail's new end; of the dark edge
_THINNEST = 0.35  # share of that at its old end
_DOT_RADIUS = 0.009  # [m]
_FLAT = 2e-4  # [m], half the thickness of what is flat
_BALL_GROUP = 0  # the ball's geom group in scene.xml, which holds nothing else
_GIF_TICK = 0.01  # [s], the format's unit of time
_GIF_MIN_DELAY = 0.02  # [s], viewers slow down frames that are shorter than this
_GIF_COLOURS = 128

CAPTION_HEIGHT = 1 / 13  # of the picture's
BACKGROUND, PLAIN, FAINT = (20, 24, 32), (255, 255, 255), (176, 186, 200)
GOOD, POOR = (122, 222, 142), (255, 160, 122)

_BACKENDS = {"Linux": ("egl", "osmesa"), "Darwin": ("cgl",), "Windows": ("glfw",)}
_KNOWN_BACKENDS = ("egl", "osmesa", "glfw", "cgl")
_NO_BACKEND = (
    "no OpenGL back end for rendering without a display: tried {}. On Debian or Ubuntu install EGL (apt-get install "
    "libegl1 libgl1 libgl1-mesa-dri) or OSMesa (apt-get install libosmesa6)"
)

Colour = tuple[float, float, float]
NO_PATH = np.empty((0, 3))


@dataclass(frozen=True)
class Caption:
    """Text from the left: ``title``, ``text`` in ``colour`` (RGB, 0 to 255); ``note`` at the right end."""

    title: str
    text: str = ""
    note: str = ""
    colour: tuple[int, int, int] = PLAIN

    def written_on(self, frame: np.ndarray) -> np.ndarray:
        """Copy of a picture (height, width, 3) uint8 with the text over its lowest thirteenth."""
        image = Image.fromarray(frame)
        bar = max(1, round(image.height * CAPTION_HEIGHT))
        top, gap = image.height - bar, 0.45 * bar
        pen = ImageDraw.Draw(image)
        pen.rectangle((0, top, image.width, image.height), fill=BACKGROUND)
        parts = ((self.title, PLAIN), (self.text, self.colour), (self.note, FAINT))
        font = ImageFont.load_default(0.55 * bar)
        widths = [pen.textlength(text, font) for text, _ in parts]
        room = image.width - gap * (1 + sum(bool(text) for text, _ in parts))
        if sum(widths) > room:  # all of it, in a smaller size
            font = ImageFont.load_default(0.55 * bar * room / sum(widths))
            widths = [pen.textlength(text, font) for text, _ in parts]
        x = gap
        for (text, colour), width in zip(parts[:2], widths[:2], strict=True):
            if text:
                pen.text((x, top + bar / 2), text, colour, font, anchor="lm")
                x += width + gap
        pen.text((image.width - gap, top + bar / 2), self.note, FAINT, font, anchor="rm")
        return np.asarray(image)


@dataclass(frozen=True)
class Moment:
    """Content of one picture.

    qpos     joint positions (n,) [m], [rad]
    ball     (3,) [m] in the world frame; not finite: left out
    trail    path (k, 3) [m] that the ball has flown, oldest first; pieces that are not finite are left out
    dots     places (m, 3) [m] that are marked, for instance where the ball is going to be
    caption  written below the scene
    """

    qpos: np.ndarray
    ball: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    trail: np.ndarray = field(default_factory=lambda: NO_PATH)
    dots: np.ndarray = field(default_factory=lambda: NO_PATH)
    caption: Caption | None = None

    def __post_init__(self) -> None:
        for name, shape in {"qpos": (None,), "ball": (3,), "trail": (None, 3), "dots": (None, 3)}.items():
            values = np.asarray(getattr(self, name), float)
            if len(shape) != values.ndim or any(n not in (None, m) for n, m in zip(shape, values.shape, strict=True)):
                wanted = ", ".join("any" if n is None else str(n) for n in shape)
                raise ValueError(f"{name} needs the shape ({wanted}), got {values.shape}")
            object.__setattr__(self, name, values)


def render_png(
    path: str | os.PathLike,
    moment: Moment,
    camera: str = CAMERA,
    size: tuple[int, int] = SIZE,
    model: mujoco.MjModel | None = None,
) -> None:
    """Writes one picture.

    camera: one of ``camera_names()``; size: (width, height) in pixels; model: a robot at the table, the paper's by
    default.
    Raises ValueError for a wrong shape, camera or suffix, RuntimeError when no OpenGL back end works.
    """
    path = _checked_path(path, (".png",))
    (frame,) = render_frames([moment], camera, size, model)
    with replacing(path) as temporary:
        Image.fromarray(frame).save(temporary, format="PNG")


def render_video(
    path: str | os.PathLike,
    moments: Sequence[Moment],
    fps: float,
    camera: str = CAMERA,
    size: tuple[int, int] = SIZE,
    model: mujoco.MjModel | None = None,
) -> None:
    """Writes a video of moments ``1 / fps`` apart. The suffix chooses the format: .mp4 (H.264) or .gif.

    Raises ValueError for a wrong shape, camera, suffix or rate, RuntimeError when no OpenGL back end works.
    """
    path = _checked_path(path, VIDEO_SUFFIXES)
    if not len(moments) or not fps > 0:
        raise ValueError(f"a video needs at least one frame and a positive fps, got {len(moments)} frames at fps {fps}")
    if path.suffix == ".mp4" and (size[0] % 2 or size[1] % 2):
        raise ValueError(f"H.264 needs an even width and height, got {size}")
    if path.suffix == ".gif" and fps * _GIF_MIN_DELAY > 1.0 + 1e-9:
        raise ValueError(f"viewers show a GIF at {1.0 / _GIF_MIN_DELAY:.0f} frames per second at most, got fps {fps}")
    frames = render_frames(moments, camera, size, model)
    with replacing(path) as temporary:
        if path.suffix == ".gif":
            _write_gif(temporary, frames, fps)
        else:
            _write_mp4(temporary, frames, fps, size)


def render_frames(
    moments: Iterable[Moment],
    camera: str = CAMERA,
    size: tuple[int, int] = SIZE,
    model: mujoco.MjModel | None = None,
) -> Iterator[np.ndarray]:
    """Pictures (height, width, 3) uint8 of moments.

    Raises ValueError for a wrong shape or camera, RuntimeError when no OpenGL back end works.
    """
    model = load_model() if model is None else model
    moments = list(moments)
    for moment in moments:
        if len(moment.qpos) != model.nq:
            raise ValueError(f"qpos needs {model.nq} joint positions, got {len(moment.qpos)}")
    if camera not in (names := camera_names(model)):
        raise ValueError(f"the scene has no camera {camera!r}; it has {names}")
    width, height = size
    if width <= 0 or height <= 0:
        raise ValueError(f"size must be positive, got {size}")
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    data = mujoco.MjData(model)
    drawn = max((2 * len(m.trail) + 2 * len(m.dots) for m in moments), default=0)
    scene = mujoco.MjvScene(model, maxgeom=model.ngeom + drawn + 10)
    option, view, perturb = mujoco.MjvOption(), mujoco.MjvCamera(), mujoco.MjvPerturb()
    option.geomgroup[_BALL_GROUP] = False
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(camera).id
    viewport, pixels = mujoco.MjrRect(0, 0, width, height), np.empty((height, width, 3), np.uint8)
    with offscreen(model, size) as context:
        for moment in moments:
            data.qpos[:] = moment.qpos
            mujoco.mj_forward(model, data)
            mujoco.mjv_updateScene(model, data, option, perturb, view, mujoco.mjtCatBit.mjCAT_ALL, scene)
            _add_ball(scene, data.cam_xpos[view.fixedcamid], moment)
            mujoco.mjr_render(viewport, scene, context)
            mujoco.mjr_readPixels(pixels, None, viewport, context)
            frame = pixels[::-1].copy()
            yield frame if moment.caption is None else moment.caption.written_on(frame)


@contextmanager
def offscreen(model: mujoco.MjModel, size: tuple[int, int]) -> Iterator[mujoco.MjrContext]:
    """A current OpenGL context of this size with the model's meshes and textures; freed on exit."""
    chosen = backend()
    try:
        gl = importlib.import_module(f"mujoco.{chosen}").GLContext(*size)
        gl.make_current()
    except Exception as error:  # PyOpenGL raises whatever its failed look-up happens to hit
        raise RuntimeError(_NO_BACKEND.format(chosen)) from error
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
    raise RuntimeError(_NO_BACKEND.format(", ".join(candidates)))


def camera_names(model: mujoco.MjModel | None = None) -> list[str]:
    """Names of the cameras of the model, by default the table-tennis scene."""
    model = load_model() if model is None else model
    return [model.camera(i).name for i in range(model.ncam)]


def _write_mp4(path: Path, frames: Iterator[np.ndarray], fps: float, size: tuple[int, int]) -> None:
    options: Any = {"codec": "libx264", "quality": 8, "macro_block_size": 2, "output_params": ["-f", "mp4"]}
    with closing(imageio_ffmpeg.write_frames(path, size, fps=fps, **options)) as writer:
        writer.send(None)  # starts the encoder
        for frame in frames:
            writer.send(np.ascontiguousarray(frame))


def _write_gif(path: Path, frames: Iterator[np.ndarray], fps: float) -> None:
    images = [Image.fromarray(frame) for frame in frames]
    # One palette for all: what does not move stays the same in every frame and costs nothing.
    some = images[:: max(1, len(images) // 8)]
    sheet = Image.new("RGB", (some[0].width, some[0].height * len(some)))
    for i, image in enumerate(some):
        sheet.paste(image, (0, i * image.height))
    palette = sheet.quantize(_GIF_COLOURS, dither=Image.Dither.NONE)
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    # Rounding the time of each frame, not its duration, keeps the video in real time.
    times = np.round(np.arange(len(images) + 1) / fps / _GIF_TICK)
    durations = [int(d) for d in np.diff(times) * _GIF_TICK * 1000]
    images[0].save(path, format="GIF", save_all=True, append_images=images[1:], duration=durations, loop=0)


def _add_ball(scene: mujoco.MjvScene, eye: np.ndarray, moment: Moment) -> None:
    """Appends trail, dots and ball to a scene seen from ``eye`` (3,) [m].

    All but the ball is flat and faces the eye; the dark edge is the same a little wider, a little farther away on the
    same lines of sight, so that it shows around the bright part from everywhere.
    """
    trail = moment.trail
    for k, (start, end) in enumerate(zip(trail[:-1], trail[1:], strict=True), start=1):
        if np.isfinite([start, end]).all():
            width = TRAIL_RADIUS * (_THINNEST + (1.0 - _THINNEST) * k / (len(trail) - 1))
            _add_ribbon(scene, eye, start, end, width, BRIGHT)
            _add_ribbon(scene, eye, _behind(eye, start), _behind(eye, end), width + EDGE, DARK)
    for dot in moment.dots[np.isfinite(moment.dots).all(axis=1)]:
        _add_disc(scene, eye, dot, _DOT_RADIUS, BRIGHT)
        _add_disc(scene, eye, _behind(eye, dot), _DOT_RADIUS + EDGE, DARK)
    if np.isfinite(moment.ball).all():
        _add_disc(scene, eye, moment.ball, RING_RADIUS, DARK)
        ball = _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, [SHOWN_RADIUS] * 3, moment.ball, np.eye(3), BRIGHT)
        ball.category = mujoco.mjtCatBit.mjCAT_DYNAMIC  # casts a shadow


def _behind(eye: np.ndarray, place: np.ndarray) -> np.ndarray:
    """A place a little farther along the line of sight."""
    return place + 0.01 * _unit(place - eye)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _add_disc(scene: mujoco.MjvScene, eye: np.ndarray, place: np.ndarray, radius: float, rgb: Colour) -> None:
    towards = _unit(eye - place)
    across = _unit(np.cross(towards, [0.0, 0.0, 1.0]))
    frame = np.stack([across, np.cross(towards, across), towards], axis=1)
    _add(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, (radius, _FLAT, 0.0), place, frame, rgb)


def _add_ribbon(
    scene: mujoco.MjvScene, eye: np.ndarray, start: np.ndarray, end: np.ndarray, half_width: float, rgb: Colour
) -> None:
    middle, along = 0.5 * (start + end), _unit(end - start)
    across = _unit(np.cross(along, eye - middle))
    frame = np.stack([along, across, np.cross(along, across)], axis=1)
    length = 0.5 * float(np.linalg.norm(end - start)) + 0.5 * half_width  # no gaps where the path bends
    _add(scene, mujoco.mjtGeom.mjGEOM_BOX, (length, half_width, _FLAT), middle, frame, rgb)


def _add(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    size: Sequence[float],
    place: np.ndarray,
    frame: np.ndarray,
    rgb: Colour,
) -> mujoco.MjvGeom:
    """Appends a geom that shines in its colour whatever the light, and casts no shadow."""
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, np.array(size), place, frame.ravel(), np.array([*rgb, 1.0], np.float32))
    geom.category, geom.emission, geom.specular = mujoco.mjtCatBit.mjCAT_DECOR, 0.8, 0.0
    scene.ngeom += 1
    return geom


def _checked_path(path: str | os.PathLike, suffixes: tuple[str, ...]) -> Path:
    path = Path(path)
    if path.suffix not in suffixes:
        raise ValueError(f"{path}: suffix {path.suffix!r}; allowed: {', '.join(suffixes)}")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: the folder {path.parent} does not exist")
    return path
