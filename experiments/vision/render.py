"""What a camera sees of a flying ball: Bayer frames (RGGB) with motion blur, noise, people, a robot and clutter.

What stands still is drawn once, in a ``Scene``. A frame draws what moves and mosaics only that, so a whole frame costs
little more than its noise. Colours are linear, as of an industrial camera without gamma.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from ballmodel import constants as c
from robot_io.vision.camera import Camera

ORANGE, WHITE = np.array([235.0, 115.0, 25.0]), np.array([235.0, 235.0, 225.0])
READ_NOISE = 1.5  # [grey levels^2]
MARGIN = 256  # [px] by which the bank of noise is larger than a frame, so that its place can be drawn
NEAREST = 0.2  # [m] of depth; nearer shapes are left out
FINER = 4  # of the table's lines, which cameras are calibrated by
PER_STEP = 1.2  # [px] between the discs that make a streak

Path = Callable[[np.ndarray], np.ndarray]  # times (n,) [s] to the ball's places (n, 3) [m]; NaN where there is none
Box = tuple[slice, slice]  # rows and columns
Window = tuple[int, int, int, int]  # x, y, width, height [px], all even


class Capsule(NamedTuple):
    """What moves: a line with round ends."""

    start: np.ndarray  # (3,) [m]
    end: np.ndarray  # (3,) [m]
    radius: float  # [m]
    colour: np.ndarray  # (3,) linear RGB, 0..255
    texture: np.ndarray | None = None  # (h, w, 3) uint8 that repeats on it instead of the colour


class Picture(NamedTuple):
    """A frame, and how much of its ball is seen."""

    frame: np.ndarray  # (h, w) uint8, Bayer RGGB
    seen: float  # share of the ball that nothing hides; 0 without a ball in the window


@dataclass
class Scene:
    """A camera and all that stands still before it; exposure and ball may be changed between frames."""

    camera: Camera
    image: np.ndarray  # (h, w, 3) uint8, linear RGB
    net: np.ndarray  # (h, w) uint8, how much the net hides
    ball: np.ndarray  # (3,) colour
    exposure: float  # [s]
    gain: float  # of the shot noise [grey levels]
    brightness: float  # factor
    blur: float  # [px] of the lens
    work: np.ndarray = field(init=False)
    bayer: np.ndarray = field(init=False)
    noise: np.ndarray = field(init=False)
    deviations: np.ndarray = field(init=False)  # (256,) [grey levels] of the noise at each level

    def __post_init__(self) -> None:
        self.work, self.bayer = self.image.copy(), mosaic(self.image)
        self.deviations = np.sqrt(self.gain * self.brightness * np.arange(256) + READ_NOISE).astype(np.float32)
        self.noise = cv2.LUT(self.bayer, self.deviations)


def mosaic(image: np.ndarray) -> np.ndarray:
    """Bayer frame (h, w), RGGB, of an RGB image (h, w, 3); h and w even."""
    bayer = np.empty(image.shape[:2], image.dtype)
    for row, column, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        bayer[row::2, column::2] = image[row::2, column::2, channel]
    return bayer


@cache
def noise_bank(height: int, width: int) -> np.ndarray:
    """Normal numbers (height + MARGIN, width + MARGIN), from which frames take theirs at a drawn place."""
    return np.random.default_rng(1).standard_normal((height + MARGIN, width + MARGIN), np.float32)


def draw_polygon(
    image: np.ndarray, camera: Camera, corners: list, colour: Sequence[float] | np.ndarray, finer: int = 1
) -> None:
    """Fills a polygon of corners (n, 3) [m]; its edges bend as the lens bends them.

    finer  factor by which it is drawn larger and averaged: OpenCV makes polygons half a pixel too large on every side
    """
    points = np.array(corners, float)
    along = np.linspace(0.0, 1.0, 12, endpoint=False)[:, None]
    edges = np.concatenate([a + (b - a) * along for a, b in zip(points, np.roll(points, -1, 0), strict=True)])
    if not (camera.depth(edges) > NEAREST).all():
        return
    pixels = camera.project(edges)
    if finer == 1:
        whole = np.clip(np.round(pixels * 16), -(2**20), 2**20).astype(np.int32)
        cv2.fillPoly(image, [whole], [float(v) for v in colour], cv2.LINE_AA, 4)
        return
    box = _clip_box(pixels.min(0) - 1, pixels.max(0) + 1, image)
    if box is None:
        return
    height, width = (side.stop - side.start for side in box)
    mask = np.zeros((height * finer, width * finer), np.uint8)
    corner = np.array([box[1].start, box[0].start])
    inside = np.round(((pixels - corner + 0.5) * finer - 0.5) * 16).astype(np.int32)
    cv2.fillPoly(mask, [inside], 255, cv2.LINE_8, 4)
    share = cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA)[..., None] / 255.0
    image[box] = (image[box] + (np.array(colour, float) - image[box]) * share).astype(np.uint8)


@cache
def photographs() -> tuple[np.ndarray, ...]:
    """Real pictures (h, w, 3) that scikit-learn and Matplotlib come with, for textures; linear RGB."""
    from matplotlib import cbook, image
    from sklearn.datasets import load_sample_images

    portrait = image.imread(str(cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)))
    pictures = [*load_sample_images().images, portrait]
    return tuple((255 * (np.asarray(p) / 255.0) ** 2.2).astype(np.uint8) for p in pictures)


def _draw_surroundings(image: np.ndarray, camera: Camera, rng: np.random.Generator) -> None:
    """Walls with panels, posters, lamps and photographs; the floor; letters, blobs as round as a ball, lines."""
    height, width = image.shape[:2]
    far = 3.0 + rng.uniform(0, 3)
    for _ in range(rng.integers(20, 60)):
        side = int(rng.integers(3))
        a, z, w, h = rng.uniform(-6, 6), rng.uniform(-0.7, 3), rng.uniform(0.1, 1.5), rng.uniform(0.05, 1.2)
        corners = [
            ((u, far + 1, v), (-far, u, v), (far, u, v))[side]
            for u, v in ((a, z), (a + w, z), (a + w, z + h), (a, z + h))
        ]
        draw_polygon(
            image, camera, corners, rng.uniform(0, 255, 3) if rng.random() < 0.7 else [rng.uniform(150, 255)] * 3
        )
    floor, end = rng.uniform(20, 140, 3), -c.TABLE_HEIGHT
    draw_polygon(image, camera, [(-far, -2.2, end), (far, -2.2, end), (far, 6, end), (-far, 6, end)], floor)
    for _ in range(rng.integers(0, 5)):
        photo = photographs()[rng.integers(len(photographs()))][:: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
        w, h = (int(v) for v in rng.integers(60, 600, 2))
        x, y = int(rng.integers(0, width - 60)), int(rng.integers(0, height - 60))
        part = cv2.resize(photo, (w, h), interpolation=cv2.INTER_AREA)[: height - y, : width - x]
        part = part * rng.uniform(0.3, 1.2, 3) if rng.random() < 0.7 else part
        image[y : y + part.shape[0], x : x + part.shape[1]] = np.clip(part, 0, 255)
    for _ in range(rng.integers(5, 40)):
        x, y = int(rng.uniform(0, width)), int(rng.uniform(0, height))
        shade = rng.uniform(0, 255, 3) if rng.random() < 0.5 else np.full(3, rng.uniform(120, 255))
        colour, kind = tuple(map(float, shade)), rng.integers(3)
        if kind == 0:
            text = "".join(rng.choice(list("ABCDEGHMOPQRSTW0389"), 5))
            cv2.putText(image, text, (x, y), 0, rng.uniform(0.3, 2), colour, int(rng.integers(1, 5)), cv2.LINE_AA)
        elif kind == 1:
            cv2.circle(image, (x, y), int(rng.uniform(3, 14)), colour, -1, cv2.LINE_AA)
        else:
            end_ = (x + int(rng.normal(0, 60)), y + int(rng.normal(0, 60)))
            cv2.line(image, (x, y), end_, colour, int(rng.integers(1, 12)), cv2.LINE_AA)


def _draw_table(image: np.ndarray, camera: Camera, colour: np.ndarray) -> None:
    x, y, line, white = c.TABLE_WIDTH / 2, c.TABLE_LENGTH / 2, 0.02, np.full(3, 225.0)
    for left, right, near, far, shade in (
        (-x, x, -y, y, colour),
        *((u, u + line, -y, y, white) for u in (-x, x - line)),
        *((-x, x, v, v + line, white) for v in (-y, y - line)),
        (-0.0015, 0.0015, -y, y, np.full(3, 200.0)),
    ):
        corners = [(left, near, 0), (right, near, 0), (right, far, 0), (left, far, 0)]
        draw_polygon(image, camera, corners, shade, FINER)


def make_scene(camera: Camera, rng: np.random.Generator) -> Scene:
    """A random hall with a table before a camera: floors, walls, lamps, colours, exposure, noise."""
    width, height = camera.size
    image = np.empty((height, width, 3), np.uint8)
    image[:] = rng.uniform(15, 110, 3) * rng.uniform(0.7, 1.3)
    _draw_surroundings(image, camera, rng)
    cloudy = cv2.resize(rng.standard_normal((height // 16, width // 16)).astype(np.float32), (width, height))
    image = np.clip(image + (cloudy * rng.uniform(0, 10))[..., None], 0, 255).astype(np.uint8)
    tops = np.array([(20, 45, 130), (15, 70, 50), (30, 30, 35), (70, 20, 40)])
    _draw_table(image, camera, tops[rng.integers(4)] * rng.uniform(0.6, 1.6))
    blur = rng.uniform(0.45, 1.0)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), blur), np.uint8)
    cover, reach, tape = np.zeros_like(image), c.TABLE_WIDTH / 2 + c.NET_OVERHANG, c.NET_HEIGHT - 0.015
    for bottom, hides in ((0.0, 110), (tape, 255)):
        corners = [(-reach, 0, bottom), (reach, 0, bottom), (reach, 0, c.NET_HEIGHT), (-reach, 0, c.NET_HEIGHT)]
        draw_polygon(cover, camera, corners, (hides,) * 3)
    net = np.ascontiguousarray(cover[..., 0])
    cloth = np.where(net == 255, 215.0, 25.0)[..., None]
    image = (image + (cloth - image) * (net[..., None] / 255.0)).astype(np.uint8)
    ball = (ORANGE if rng.random() < 0.6 else WHITE) * rng.uniform(0.8, 1.08, 3)
    return Scene(
        camera, image, net, np.minimum(ball, 255), blur=blur,
        exposure=rng.uniform(0.0008, 0.0045), gain=rng.uniform(0.05, 0.4), brightness=rng.uniform(0.45, 1.1),
    )  # fmt: skip


class Actors:
    """A person at the far end, a robot at the near one, and small things that move but are no balls.

    Args:
        rng: draws their looks and motions.
        clutter: most small things.
        dressed: whether the person wears photographs, as clothes, skin and logos have structure.
    """

    def __init__(self, rng: np.random.Generator, clutter: int = 4, dressed: bool = False) -> None:
        self.at, self.phase, self.pace = rng.uniform(-0.5, 0.5), rng.uniform(0, 6.3, 4), rng.uniform(3, 9)
        self.far = rng.uniform(1.6, 2.3)
        shirt = np.full(3, rng.uniform(170, 250)) if rng.random() < 0.5 else rng.uniform(0, 200, 3)
        skin = np.array([215, 150, 110.0]) * rng.uniform(0.35, 1.05)
        self.robot = np.array([(225, 105, 30), (220, 220, 215), (40, 40, 45)][rng.integers(3)])
        trousers, hair = rng.uniform(0, 120, 3), rng.uniform(0, 90, 3)
        self.rubber = np.array([(150, 20, 20), (20, 20, 20), (30, 60, 150)][rng.integers(3)])
        self.logos = [
            (rng.uniform([-0.12, 0.2], [0.12, 0.55]), rng.uniform(0, 0.05),
             rng.uniform(0.008, 0.03), rng.uniform(0, 255, 3))
            for _ in range(rng.integers(1, 5))
        ]  # fmt: skip
        self.things = []
        for _ in range(rng.integers(0, clutter + 1)):
            radius = rng.uniform(0.004, 0.035)
            way = rng.normal(size=3)
            length = way / np.linalg.norm(way) * radius * rng.uniform(2.5, 9)  # longer than any ball's streak is wide
            colour = (ORANGE, WHITE, skin)[rng.integers(3)] if rng.random() < 0.5 else rng.uniform(0, 255, 3)
            middle = rng.uniform([-1.0, -1.6, -0.1], [1.0, 2.0, 0.8])
            self.things.append(
                (middle, length, radius, colour, rng.uniform(0.05, 0.5, 3), rng.uniform(2, 14), rng.uniform(0, 6.3, 3))
            )
        parts = {"shirt": shirt, "trousers": trousers, "skin": skin, "hair": hair}
        # Colour and texture of each part.
        self.dress = {name: (colour, _weave(colour, rng) if dressed else None) for name, colour in parts.items()}

    def capsules(self, time: float, ball: np.ndarray | None) -> list[Capsule]:
        """All shapes at a time [s]; the paddles follow a ball (3,) [m] that is near, None or NaN: none is."""
        swing = np.sin(self.pace * time + self.phase)
        wrist = np.array([-self.at + 0.4 * swing[3], -1.75 + 0.1 * swing[1], 0.25 + 0.15 * swing[0]])
        if ball is not None and ball[1] < -1.2:
            wrist = wrist + (ball - [0, 0.09, 0] - wrist) * min(1.0, (-1.2 - ball[1]) / 0.3)
        elbow, base = wrist - [0, 0.25, -0.15], np.array([0.2, -2.3, 0.3])
        return [
            *self.person(time, ball),
            Capsule(base, elbow, 0.07, self.robot),
            Capsule(elbow, wrist, 0.045, self.robot),
            Capsule(wrist, wrist + [0.02, 0, 0.03], 0.075, np.full(3, 20.0)),
        ]

    def person(self, time: float, ball: np.ndarray | None) -> list[Capsule]:
        """The same without the robot."""
        swing = np.sin(self.pace * time + self.phase)
        x, y = self.at + 0.25 * swing[0], self.far + 0.1 * swing[1]
        hip, neck, head = np.array([(x, y, 0.1), (x, y - 0.1, 0.62), (x, y - 0.12, 0.82)])
        hand = np.array([x + 0.35 + 0.25 * swing[2], y - 0.45 + 0.2 * swing[3], 0.25 + 0.2 * swing[2]])
        if ball is not None and ball[1] > self.far - 0.9:
            hand = hand + (ball + [0, 0.08, 0] - hand) * min(1.0, (ball[1] - self.far + 0.9) / 0.5)
        shoulder, left = np.array([x + 0.2, y - 0.1, 0.55]), np.array([x - 0.22, y - 0.1, 0.55])
        shapes = [
            Capsule(np.array((x - 0.1, y, -0.7)), hip, 0.09, *self.dress["trousers"]),
            Capsule(np.array((x + 0.1, y, -0.7)), hip, 0.09, *self.dress["trousers"]),
            Capsule(hip, neck, 0.17, *self.dress["shirt"]),
            Capsule(head, head, 0.1, *self.dress["skin"]),
            Capsule(head + [0, 0.07, 0.06], head + [0, 0.07, 0.06], 0.09, *self.dress["hair"]),
            Capsule(left, left + [-0.1 * swing[0], -0.3, -0.25 + 0.15 * swing[3]], 0.04, *self.dress["skin"]),
            Capsule(shoulder, hand, 0.045, *self.dress["skin"]),
            Capsule(hand, hand + [0.02, 0, 0.03], 0.075, self.rubber),
        ]
        for (u, v), wide, radius, colour in self.logos:
            spot = np.array([x + u, y - 0.27, v])
            shapes.append(Capsule(spot, spot + [wide, 0, 0], radius, colour))
        for middle, length, radius, colour, reach, pace, phase in self.things:
            spot = middle + reach * np.sin(pace * time + phase)
            shapes.append(Capsule(spot, spot + length, radius, colour))
        return shapes


def _weave(colour: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A texture (128, 128, 3) of a photograph's part in a colour."""
    photo = photographs()[rng.integers(len(photographs()))]
    size = int(rng.integers(40, 300))
    y, x = (int(rng.integers(0, side - size)) for side in photo.shape[:2])
    part = cv2.resize(photo[y : y + size, x : x + size], (128, 128), interpolation=cv2.INTER_AREA)
    share = rng.uniform(0.2, 0.9)
    return np.clip(share * part + (1 - share) * colour, 0, 255).astype(np.uint8)


def render(
    scene: Scene,
    path: Path,
    time: float,
    rng: np.random.Generator,
    shapes: list[Capsule] | tuple[()] = (),
    window: Window | None = None,
) -> Picture:
    """One frame, whole or of a window, exposed around ``time`` [s].

    Args:
        scene: what stands still, and the looks.
        path: where the ball is.
        time: middle of the exposure.
        rng: draws the noise.
        shapes: what moves but the ball.
        window: x, y, width, height [px]; must be even, so that the colours stay where they are.
    """
    camera = scene.camera
    x0, y0, width, height = window or (0, 0, *camera.size)
    view = (slice(y0, y0 + height), slice(x0, x0 + width))
    image, origin = scene.work[view], np.array([x0, y0])
    places = path(time + scene.exposure * np.linspace(-0.5, 0.5, 9))
    places = places[~np.isnan(places[:, 0])]
    # The streak counts where the middle of the exposure has a ball; a ball struck within it is seen for a part.
    spot = float(camera.depth(places).mean()) if len(places) else -1.0
    if spot < NEAREST:
        places, spot = places[:0], -1.0
    ends = np.array([(s.start, s.end) for s in shapes]).reshape(-1, 2, 3)
    depths, pixels = camera.depth(ends), camera.project(ends) - origin
    middles, radii = depths.mean(1), [camera.matrix[0, 0] * s.radius for s in shapes]
    order = [i for i in np.argsort(-middles, kind="stable") if depths[i].min() > NEAREST]
    farther = sum(middles[i] >= spot for i in order)
    seen, patch = 0.0, None
    boxes = [_draw_capsule(image, pixels[i], radii[i] / middles[i], shapes[i]) for i in order[:farther]]
    if len(places):
        boxes.append(_draw_shadow(scene, image, places[len(places) // 2], origin))
        seen, patch = _draw_ball(scene, image, places, origin)
        boxes.append(patch)
    for i in order[farther:]:
        before = image[patch].copy() if patch else None
        boxes.append(_draw_capsule(image, pixels[i], radii[i] / middles[i], shapes[i]))
        if patch and before is not None:
            seen *= 1.0 - float((before != image[patch]).any(-1).mean())
    drawn = [box for box in boxes if box is not None]
    bayer, deviation = scene.bayer[view], scene.noise[view]
    if drawn:
        bayer, deviation = bayer.copy(), deviation.copy()
    still = scene.image[view]
    for rows, columns in drawn:
        # The colours of a quad are where they are in the whole frame.
        box = tuple(slice(side.start // 2 * 2, (side.stop + 1) // 2 * 2) for side in (rows, columns))
        bayer[box] = mosaic(image[box])
        deviation[box] = cv2.LUT(bayer[box], scene.deviations)
    for box in drawn:
        image[box] = still[box]
    bank = noise_bank(camera.size[1], camera.size[0])
    y, x = rng.integers(0, MARGIN, 2)
    noise = cv2.multiply(deviation, bank[y : y + height, x : x + width])
    return Picture(cv2.addWeighted(bayer, scene.brightness, noise, 1.0, 0.0, dtype=cv2.CV_8U), seen)


def _draw_capsule(image: np.ndarray, pair: np.ndarray, radius: float, shape: Capsule) -> Box | None:
    """Draws a line (2, 2) [px] with round ends; the box that it covers, None outside."""
    box = _clip_box(pair.min(0) - radius - 2, pair.max(0) + radius + 2, image)
    if box is None:
        return None
    a, b = (tuple(np.round(p * 16).astype(int).tolist()) for p in pair)
    width = max(1, int(2 * radius))
    if shape.texture is None:
        cv2.line(image, a, b, [float(v) for v in shape.colour], width, cv2.LINE_AA, 4)
        return box
    inside = np.zeros(image.shape[:2], np.uint8)
    cv2.line(inside, a, b, 255.0, width, cv2.LINE_8, 4)
    rows, columns = (np.arange(side.start, side.stop) for side in box)
    # It moves with the shape's first end.
    u, v = np.round(pair[0]).astype(int)
    cloth = shape.texture[((rows - v) % len(shape.texture))[:, None], (columns - u) % shape.texture.shape[1]]
    chosen = inside[box] > 0
    image[box][chosen] = cloth[chosen]
    return box


def _clip_box(low: np.ndarray, high: np.ndarray, image: np.ndarray) -> Box | None:
    """Rows and columns of a box of pixels within a picture, or None where they do not meet."""
    height, width = image.shape[:2]
    x0, x1 = max(int(low[0]), 0), min(int(high[0]) + 2, width)
    y0, y1 = max(int(low[1]), 0), min(int(high[1]) + 2, height)
    return (slice(y0, y1), slice(x0, x1)) if x1 - x0 > 1 and y1 - y0 > 1 else None


def _draw_shadow(scene: Scene, image: np.ndarray, ball: np.ndarray, origin: np.ndarray) -> Box | None:
    """The shadow on the table, right below the ball."""
    if abs(ball[0]) > c.TABLE_WIDTH / 2 or abs(ball[1]) > c.TABLE_LENGTH / 2 or ball[2] < 0:
        return None
    camera, foot = scene.camera, np.array([ball[0], ball[1], 0.0])
    spot, radius = camera.project(foot) - origin, camera.matrix[0, 0] * c.BALL_RADIUS / camera.depth(foot)
    box = _clip_box(spot - 2 * radius - 3, spot + 2 * radius + 3, image)
    if box is not None:
        ys, xs = np.mgrid[box]
        inside = np.clip(1.5 - np.hypot(xs - spot[0], (ys - spot[1]) * 1.7) / radius, 0, 1)[..., None]
        image[box] = (image[box] * (1 - np.clip(0.5 - ball[2], 0.05, 0.5) * inside)).astype(np.uint8)
    return box


def _draw_ball(scene: Scene, image: np.ndarray, places: np.ndarray, origin: np.ndarray) -> tuple[float, Box | None]:
    """Draws the exposure's streak; share of it that the net and the picture's edge leave, and the box it covers."""
    camera, pixels = scene.camera, scene.camera.project(places) - origin
    radius = float(camera.matrix[0, 0] * c.BALL_RADIUS / camera.depth(places).mean())
    box = _clip_box(pixels.min(0) - radius - 3, pixels.max(0) + radius + 3, image)
    if box is None:
        return 0.0, None
    steps = max(2, int(np.linalg.norm(np.diff(pixels, axis=0), axis=1).sum() / PER_STEP) + 1)
    at, known = np.linspace(0, len(pixels) - 1, steps), np.arange(len(pixels))
    us, vs = (np.interp(at, known, pixels[:, k]).astype(np.float32)[:, None, None] for k in (0, 1))
    ys, xs = (a.astype(np.float32) for a in np.mgrid[box])
    dx, dy = (xs - us) / radius, (ys - vs) / radius
    squared = dx**2 + dy**2
    inside = np.clip((1 - np.sqrt(squared)) * (radius / (2.0 * scene.blur)) + 0.5, 0, 1)
    shade = (inside * np.clip(0.75 - 0.3 * dy - 0.25 * squared, 0.15, 1.1)).mean(0)
    cover = inside.mean(0)
    whole = float(np.pi * radius**2 + 2 * radius * np.linalg.norm(pixels[-1] - pixels[0]))
    hidden = 0.0
    if places[0][1] * camera.centre[1] < 0:  # behind the net, perhaps
        x, y = (int(v) for v in origin)
        veil = scene.net[box[0].start + y : box[0].stop + y, box[1].start + x : box[1].stop + x] / 255.0
        hidden = float((veil * cover).sum() / max(cover.sum(), 1e-9))
        cover, shade = cover * (1 - veil), shade * (1 - veil)
    patch = image[box]
    image[box] = np.clip(patch * (1 - cover[..., None]) + (shade[..., None] * 1.1) * scene.ball, 0, 255).astype(
        np.uint8
    )
    cut = (inside.max(0) > 0.5).sum() / whole
    return (1.0 - hidden) * (min(1.0, cut) if cut < 0.9 else 1.0), box


def no_ball(times: np.ndarray) -> np.ndarray:
    """The path of no ball."""
    return np.full((len(times), 3), np.nan)


def follow(track: np.ndarray, start: float = 0.0, rate: float = 1000.0) -> Path:
    """The path of a track (n, 3) [m] of ``rate`` [Hz] that begins at ``start`` [s]."""
    known = start + np.arange(len(track)) / rate

    def place(times: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(times, known, track[:, k], np.nan, np.nan) for k in range(3)], -1)

    return place
