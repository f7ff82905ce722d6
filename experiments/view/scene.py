"""Tables side by side in a browser: robots, balls with their trails, and where they will come down."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import trimesh
import viser
from mjviser import ViserMujocoScene

from ballmodel.constants import TABLE_LENGTH, TABLE_WIDTH
from experiments.view.replay import RATE, Replay
from mjx_tt.env.return_flight import FLOOR
from mjx_tt.robot.mjcf import PADDLE_SITE
from mjx_tt.robot.robots import Robot

SPACING = -3.2  # [m] from the middle of a table to the next one's, which stands to its right for the person
BALL_TRAIL, PADDLE_TRAIL = 0.25, 0.35  # [s]
STRIDE = 4  # frames from one point of a trail to the next
NAMED = 2  # tables up to which a label has room for its policy's name; more have numbers
# Width over height of the picture: below the first the camera steps back, to the second of its distance over it.
NARROW_FOR_ONE, NARROW_FOR_SEVERAL = (1.0, 1.3), (1.15, 1.15)
PANEL_BELOW = 0.8  # width over height below which a panel may cover the lower half of the picture
RAISED = 0.19  # distances that the camera then looks below the table
SHOWN_RADIUS = 0.025  # [m]; the true ball, of 0.02 m, is hard to find on a small screen
COLOURS = {
    "ball": (255, 240, 25),
    "measured": (255, 240, 25),
    "simulated": (40, 90, 200),
    "nominal": (200, 40, 60),
    "extended": (20, 140, 70),
}
WAY_COLOURS = {"ball": (120, 90, 0), "measured": (120, 90, 0)}  # of thin lines, on white and on blue
EDGE = (5, 8, 18)  # around the ball and behind its trail: one of the two stands out from whatever lies behind
RING_RADIUS = 0.037  # [m]
BEHIND = np.array([-0.006, -0.02, -0.008], np.float32)  # [m] away from where people look from
PADDLE_COLOUR, LANDING_COLOUR, MARK_COLOUR = (150, 60, 170), (20, 160, 80), (90, 60, 30)
NOWHERE = np.full((1, 2, 3), -5.0)  # a segment below the floor


def build_tables(count: int, robot: Robot) -> mujoco.MjModel:
    """The scene ``count`` times, along x, without its floor and ball; the person's place is a disc."""
    parts = [mujoco.MjSpec.from_file(str(robot.scene())) for _ in range(count)]
    for i, part in enumerate(parts):
        # What is seen through is not here, and would hide the ball.
        figure = [geom.name for geom in part.geoms if geom.name.startswith("person") and geom.name != "person_place"]
        for name in ("floor", "ball", *figure):
            part.delete(part.geom(name))
        if i:
            parts[0].attach(part, prefix=f"{i}-", frame=parts[0].worldbody.add_frame(pos=offset(i)))
    return parts[0].compile()


def offset(table: int) -> np.ndarray:
    """Middle (3,) [m] of a table."""
    return np.array([SPACING * table, 0.0, 0.0])


def segments(path: np.ndarray) -> np.ndarray:
    """Pieces (n, 2, 3) of a path, without those that have an end which is not finite."""
    pieces = np.stack([path[:-1], path[1:]], axis=1)
    pieces = pieces[np.isfinite(pieces).all(axis=(1, 2))]
    return pieces if len(pieces) else NOWHERE


class Scene:
    """Shows one replay per table."""

    def __init__(self, server: viser.ViserServer, count: int, robot: Robot) -> None:
        self.server, self.count = server, count
        self._model = build_tables(count, robot)
        self._joints = self._model.nq // count
        self._data = mujoco.MjData(self._model)
        self._paddles = [i for i in range(self._model.nsite) if self._model.site(i).name.endswith(PADDLE_SITE)]
        self._robots = ViserMujocoScene(server, self._model, num_envs=1)
        self._robots.camera_tracking_enabled = False
        self._replays: Sequence[Replay] = ()
        self._balls: dict[tuple[int, str], tuple[viser.IcosphereHandle, viser.MeshHandle]] = {}
        self._paddle_paths: list[np.ndarray] = []
        add = server.scene
        # Without a graphics card, shadow maps and reflections take a hundred times as long as all the rest.
        add.configure_environment_map(None)
        add.configure_default_lights(cast_shadow=False)
        add.add_light_hemisphere("/light", ground_color=(225, 225, 220), intensity=3.0)
        floor: Any = {"cell_color": (228, 228, 228), "section_color": (205, 205, 205), "plane_color": (246, 246, 244)}
        add.add_grid(
            "/floor", infinite_grid=True, fade_distance=14.0, plane_opacity=1.0, position=(0.0, 0.0, FLOOR), **floor
        )
        self._trail_edge = add.add_line_segments("/trail/edge", NOWHERE, EDGE, thickness=0.026)
        self._trail = add.add_line_segments("/trail/ball", NOWHERE, COLOURS["ball"], thickness=0.014)
        self._paddle_trail = add.add_line_segments("/trail/paddle", NOWHERE, PADDLE_COLOUR, thickness=0.010)
        self._ways = {
            name: add.add_line_segments(f"/way/{name}", NOWHERE, WAY_COLOURS.get(name, colour), thickness=0.004)
            for name, colour in COLOURS.items()
        }
        self._marks = add.add_point_cloud("/marks", NOWHERE[0], MARK_COLOUR, point_size=0.007, point_shape="circle")
        tables = range(count)
        landing: Any = {"color": LANDING_COLOUR, "opacity": 0.8}
        shadow: Any = {"color": (20, 25, 40), "opacity": 0.5}
        self._landing = [add.add_cylinder(f"/landing/{i}", 0.06, 0.004, **landing) for i in tables]
        self._shadows = [add.add_cylinder(f"/shadow/{i}", SHOWN_RADIUS, 0.002, **shadow) for i in tables]
        style: Any = {"anchor": "bottom-center", "font_screen_scale": 1.2}
        self._labels = [
            add.add_label(f"/label/{i}", "", position=offset(i) + (0.0, -1.0, 1.0 + 0.35 * (i % 2)), **style)
            for i in tables
        ]
        middle, further = offset(count - 1)[0] / 2, 3.1 * (count - 1)
        camera = server.initial_camera
        camera.look_at = (middle, -0.75, 0.05)
        camera.position = (middle + (1.2 if count == 1 else 0.0), 2.75 + further, 1.35 + 0.4 * further)
        camera.fov = math.radians(50.0)
        self._start = np.array([camera.position, camera.look_at])
        server.on_client_connect(self._fit_camera)

    def _fit_camera(self, client: viser.ClientHandle) -> None:
        """Fits the tables into a page's picture, whose size changes when the panel docks; a hand's view stays."""
        placed = self._start

        def fit(camera: viser.CameraHandle) -> None:
            nonlocal placed
            wanted = self._view(camera.aspect)
            if any(np.allclose(camera.position, view[0], atol=1e-3) for view in (placed, self._start)):
                if not np.allclose([camera.position, camera.look_at], wanted, atol=1e-3):
                    placed = wanted
                    camera.position, camera.look_at = wanted

        async def updated(camera: viser.CameraHandle) -> None:  # in the order in which the page's messages come
            fit(camera)

        fit(client.camera)
        client.camera.on_update(updated)

    def _view(self, aspect: float) -> np.ndarray:
        """Position and target (2, 3) [m] from which a picture of this width over height shows the tables whole."""
        narrow, wanted = NARROW_FOR_ONE if self.count == 1 else NARROW_FOR_SEVERAL
        position, at = self._start
        away = (position - at) * (wanted / max(aspect, 0.1) if aspect < narrow else 1.0)
        below = RAISED * np.linalg.norm(away) if aspect < PANEL_BELOW else 0.0
        return np.array([at + away, at - np.array([0.0, 0.0, below])])

    def load(self, replays: Sequence[Replay]) -> None:
        """Takes the replays to show, one for each table."""
        self._replays = replays
        wanted = {(i, name) for i, replay in enumerate(replays) for name in replay.balls}
        for key in set(self._balls) - wanted:
            for part in self._balls.pop(key):
                part.remove()
        add = self.server.scene
        for i, name in sorted(wanted - set(self._balls)):
            ball = add.add_icosphere(f"/ball/{i}/{name}", SHOWN_RADIUS, COLOURS[name])
            # Of the larger sphere only the far side is drawn, which shows as a ring around the ball.
            shape = trimesh.creation.icosphere(subdivisions=2, radius=RING_RADIUS)
            ring = add.add_mesh_simple(f"/ring/{i}/{name}", shape.vertices, shape.faces, color=EDGE, side="back")
            self._balls[i, name] = ball, ring
        for name, way in self._ways.items():
            paths = [segments(offset(i) + r.balls[name][::STRIDE]) for i, r in enumerate(replays) if name in r.balls]
            way.points = np.concatenate(paths or [NOWHERE]).astype(np.float32)
        marks = [offset(i) + replay.marks for i, replay in enumerate(replays) if len(replay.marks)]
        self._marks.points = np.concatenate(marks or [NOWHERE[0]]).astype(np.float32)
        self._paddle_paths = [self._paddle_path(i, replay) for i, replay in enumerate(replays)]

    def show(self, t: float) -> None:
        """Draws the moment ``t`` [s] of every replay."""
        trails, paddles = [], []
        frames = [replay.frame(t) for replay in self._replays]
        for i, (replay, frame) in enumerate(zip(self._replays, frames, strict=True)):
            self._data.qpos[self._joints * i : self._joints * (i + 1)] = replay.qpos[frame]
            ball, paddle = (max(0, frame - round(seconds * RATE)) for seconds in (BALL_TRAIL, PADDLE_TRAIL))
            trails.append(segments(offset(i) + replay.trail[ball : frame + 1 : STRIDE]))
            paddles.append(segments(self._paddle_paths[i][paddle // STRIDE : frame // STRIDE + 1]))
        mujoco.mj_kinematics(self._model, self._data)
        self._robots.update_from_mjdata(self._data)
        with self.server.atomic():
            for i, (replay, frame) in enumerate(zip(self._replays, frames, strict=True)):
                self._show_table(i, replay, frame, t)
            self._trail.points = np.concatenate(trails).astype(np.float32)
            self._trail_edge.points = self._trail.points + BEHIND
            self._paddle_trail.points = np.concatenate(paddles).astype(np.float32)
        self.server.flush()

    def _show_table(self, i: int, replay: Replay, frame: int, t: float) -> None:
        """Places balls, shadow, landing and label of one table."""
        for name, path in replay.balls.items():
            for part in self._balls[i, name]:
                _place(part, offset(i) + path[frame])
        at, landing = replay.trail[frame], replay.landing[frame]
        over = abs(at[0]) < TABLE_WIDTH / 2 and abs(at[1]) < TABLE_LENGTH / 2 and at[2] > 0.0
        _place(self._landing[i], offset(i) + (*landing, 0.004))
        _place(self._shadows[i], offset(i) + (*at[:2], 0.003 if over else FLOOR + 0.003))
        text = self._label(i, replay, t)
        if self._labels[i].text != text:
            self._labels[i].text = text

    def _label(self, table: int, replay: Replay, t: float) -> str:
        """Label above a table, short where labels stand beside each other; the panel has it in full."""
        name = replay.title if self.count <= NAMED else str(table + 1)
        if not replay.outcome or t < replay.decided:
            return name
        if self.count == 1:
            return f"{name}\n{replay.outcome}"  # a line each: a phone has no room for both in one
        return f"{name}: {replay.outcome.partition(',')[0]}"

    def _paddle_path(self, table: int, replay: Replay) -> np.ndarray:
        path = []
        for qpos in replay.qpos[::STRIDE]:
            self._data.qpos[self._joints * table : self._joints * (table + 1)] = qpos
            mujoco.mj_kinematics(self._model, self._data)
            path.append(self._data.site_xpos[self._paddles[table]].copy())
        return np.array(path)


def _place(node: Any, position: np.ndarray) -> None:
    """Shows a node of the scene at a position, or hides it where that is not finite."""
    node.visible = bool(np.isfinite(position).all())
    if node.visible:
        node.position = position
