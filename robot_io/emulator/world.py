"""The rig's world: one MuJoCo C simulation of robot, table, net and a ball, with contacts.

Another physics than the training's on purpose. The ball is a free body: MuJoCo integrates its flight and its impacts
are MuJoCo contacts that last about 2 ms. The air's drag and the tangential impulses are applied here: MuJoCo has no
drag for such a ball and no rubber, and the friction of its soft contacts takes from the bounce when a ball
slides. The robot's
drives follow velocity set-points, as in the training's model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np

from ballmodel.constants import (
    BALL_MASS,
    BALL_RADIUS,
    PADDLE_RADIUS,
    PADDLE_THICKNESS,
    RUBBER_TANGENTIAL_GAIN,
    SHELL_INERTIA_FACTOR,
    TABLE_FRICTION,
    TABLE_RESTITUTION,
)
from ballmodel.io.ranges import Within
from robot_io.contract import PAPER, Contract

SHELL_INERTIA = SHELL_INERTIA_FACTOR * BALL_MASS * BALL_RADIUS**2
SOLIMP = [0.95, 0.95, 0.001, 0.5, 2.0]  # the same impedance at any depth: a linear spring
CONTACT_TIME = 0.002  # [s] half a period of the contact's spring; measured ones last 1 ms and need smaller steps
STIFFNESS = (math.pi / CONTACT_TIME) ** 2
PARKED = (0.0, 6.0, -0.5)  # [m] where the ball waits, out of everybody's sight
PADDLE_HALF_THICKNESS = PADDLE_THICKNESS / 2
FLOOR = -0.74  # [m] height of the ball's centre on the floor
STICKING = 2.0 / 5.0  # share of the slip that brings the contact point of a thin shell to rest
NET = (0.1, 0.3)  # restitution and friction
PHASES = 6  # of a contact's beginning within a step, for the calibration
RESTING = 0.1  # [m/s]
CLIP = (0.0, PADDLE_RADIUS + BALL_RADIUS + 0.003, 0.0)  # [m] of a ball at the blade's edge, in the site's frame
FINE = 4  # steps instead of one near a surface
NEAR = 0.06  # [m] from the ball's centre: a ball at 20 m/s moves 0.02 m in a step

Vector = Sequence[float] | np.ndarray  # (3,)
ZERO = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class WorldParams:
    """Physics of the rig.

    timestep              [s] longest; near a surface the ball is integrated with a quarter of it
    drag                  K_d [1/m] in the deceleration K_d v^2 (paper's ball: 0.47 x 1.29 x 1.256e-3 / (2 x 0.0027))
    magnus                K_m in K_m omega x v
    table_restitution     at table_speed
    table_friction        Coulomb
    paddle_restitution    at 5 m/s
    rubber_gain           tangential impulse of the rubber over slip and mass
    """

    timestep: Annotated[float, Within(1e-4, 0.002, "s")] = 0.001
    drag: Annotated[float, Within(0.0, 10.0, "1/m")] = 0.141
    magnus: Annotated[float, Within(-1.0, 1.0)] = 0.0
    table_restitution: Annotated[float, Within(0.01, 1.0)] = TABLE_RESTITUTION
    table_friction: Annotated[float, Within(0.0, 10.0)] = TABLE_FRICTION
    paddle_restitution: Annotated[float, Within(0.01, 1.0)] = 0.81
    rubber_gain: Annotated[float, Within(0.0, 2.0)] = RUBBER_TANGENTIAL_GAIN


class World:
    """Robot and ball; positions in the table frame, SI units."""

    def __init__(self, scene: str | Path, params: WorldParams | None = None, contract: Contract = PAPER) -> None:
        self._arm = list(contract.arm)
        self.params = params or WorldParams()
        robot = mujoco.MjModel.from_xml_path(str(scene))
        self.model = _model(str(scene), robot, self.params)
        self.data = mujoco.MjData(self.model)
        joint = [self.model.joint(name) for name in contract.joints]
        self._q = np.array([j.qposadr[0] for j in joint])
        self._v = np.array([j.dofadr[0] for j in joint])
        free = self.model.joint("ball_free")
        self._ball_q, self._ball_v = int(free.qposadr[0]), int(free.dofadr[0])
        self._ball_body = self.model.body("ball").id
        # Views of the ball's state; the spin is in its body's frame, which the rotation turns into the table's.
        self._position, self._velocity = self.data.qpos[self._ball_q :][:3], self.data.qvel[self._ball_v :][:3]
        self._body_spin = self.data.qvel[self._ball_v + 3 :][:3]
        self._rotation = self.data.xmat[self._ball_body].reshape(3, 3)
        self._ball_geom, self._paddle_geom = self.model.geom("ball").id, self.model.geom("rig_paddle").id
        self._site = self.model.site("paddle").id
        self.home = robot.key("home").qpos[[robot.joint(name).qposadr[0] for name in contract.joints]].copy()
        self._surfaces = {
            self.model.geom("col_table").id: (self.params.table_restitution, self.params.table_friction),
            self.model.geom("net").id: NET,
        }
        self.reset()

    def reset(self) -> None:
        """Robot at home and at rest, ball away, time zero."""
        mujoco.mj_resetData(self.model, self.data)
        self.number = self.strokes = 0  # of the ball in play, of the human
        self.touches: list[tuple[float, str, np.ndarray]] = []  # of the ball in play: time, geom, ball's position
        self._touching: set[int] = set()  # geoms
        self.collisions = 0  # steps in which robot and table touched
        self.held: np.ndarray | None = None  # [m] where a hand holds the ball
        self.on_blade = False  # the ball is clipped to the blade
        self.data.qpos[self._q] = self.home
        self.park()
        mujoco.mj_forward(self.model, self.data)

    @property
    def time(self) -> float:
        return self.data.time

    @property
    def qpos(self) -> np.ndarray:
        """Joint positions (8,)."""
        return self.data.qpos[self._q]

    @property
    def qvel(self) -> np.ndarray:
        return self.data.qvel[self._v]

    @property
    def ball(self) -> np.ndarray:
        """Position (3,) [m] of the ball, wherever it is."""
        return self._position.copy()

    @property
    def ball_velocity(self) -> np.ndarray:
        return self._velocity.copy()

    @property
    def ball_spin(self) -> np.ndarray:
        """Angular velocity (3,) [rad/s] in the table frame."""
        return self._rotation @ self._body_spin

    @property
    def answered(self) -> bool:
        """False from the bounce of the robot's return on the human's half until it is struck again, or for ever."""
        hit = next((t for t, name, _ in self.touches if name == "rig_paddle"), None)
        return hit is None or not any(name == "col_table" and t > hit and p[1] > 0.0 for t, name, p in self.touches)

    def throw(self, position: Vector, velocity: Vector, spin: Vector = ZERO) -> None:
        """Puts a new ball into play."""
        self.number, self.in_play = self.number + 1, True
        self._start(position, velocity, spin)

    def strike(self, velocity: Vector, spin: Vector) -> None:
        """Gives the ball in play another velocity and spin, where it is."""
        self._start(self.ball, velocity, spin)

    def _start(self, position: Vector, velocity: Vector, spin: Vector) -> None:
        self._place(position, velocity, spin)
        mujoco.mj_kinematics(self.model, self.data)  # the ball's orientation is looked at before the next step
        self._touching, self.touches = set(), []
        self.strokes += 1

    @property
    def visible(self) -> bool:
        """True while there is a ball to be seen."""
        return self.in_play or self.on_blade or self.held is not None

    @property
    def clipped(self) -> np.ndarray:
        """Where a ball is (3,) [m] that is clipped to the blade, at its edge and beside its axis."""
        site = self.data.site_xpos[self._site], self.data.site_xmat[self._site].reshape(3, 3)
        return site[0] + site[1] @ np.array(CLIP)

    def jog(self, whole: bool = False) -> None:
        """Puts the arm to its home pose, as somebody does with the controller's own pendant.

        whole: the linear axes as well, which are pushed by hand, without power.
        """
        joints = slice(None) if whole else self._arm
        self.hold(joints, self.home[joints])

    def hold(self, joints: int | slice | list[int], place: float | np.ndarray) -> None:
        """Puts joints to a place, at rest: an obstacle is there."""
        self.data.qpos[self._q[joints]], self.data.qvel[self._v[joints]] = place, 0.0
        mujoco.mj_forward(self.model, self.data)

    def park(self) -> None:
        """Takes the ball out of play."""
        self._place(PARKED, ZERO, ZERO)
        self.in_play = False

    def _place(self, position: Vector, velocity: Vector, spin: Vector) -> None:
        self.data.qpos[self._ball_q :][:7] = [*position, 1.0, 0.0, 0.0, 0.0]
        self.data.qvel[self._ball_v :][:6] = [*velocity, *spin]
        self.data.xfrc_applied[self._ball_body] = 0.0

    def advance(self, setpoint: np.ndarray, duration: float) -> None:
        """Moves on by ``duration`` [s] with the drives' velocity set-points (8,)."""
        self.data.ctrl[:] = setpoint
        steps = max(1, math.ceil(duration / self.params.timestep - 1e-9))
        for _ in range(steps):
            self._step(duration / steps)

    def _step(self, duration: float) -> None:
        if self.visible and not self.in_play:
            self._integrate(1, duration)
            place = self.clipped if self.on_blade else self.held
            self._place(PARKED if place is None else place, ZERO, ZERO)
            return
        if not self.in_play:
            self._place(PARKED, ZERO, ZERO)
            self._integrate(1, duration)
            return
        steps = FINE if self._near_surface() else 1
        self._integrate(steps, duration / steps)
        _, y, z = self._position
        resting = z < 2.0 * BALL_RADIUS and self._velocity @ self._velocity < RESTING**2  # nobody plays it any more
        if z < FLOOR or abs(y) > 5.0 or resting:
            self.park()

    def _near_surface(self) -> bool:
        x, y, z = self._position
        over_table, at_net = z < NEAR and abs(x) < 0.8 and abs(y) < 1.45, abs(y) < NEAR and z < 0.25
        arm = self._position - self.data.site_xpos[self._site]
        return bool(over_table or at_net or arm @ arm < (PADDLE_RADIUS + NEAR) ** 2)

    def _integrate(self, steps: int, timestep: float) -> None:
        data, velocity = self.data, self._velocity
        self.model.opt.timestep = timestep
        for _ in range(steps):
            if self.in_play:
                acceleration = -self.params.drag * np.sqrt(velocity @ velocity) * velocity
                if self.params.magnus:
                    acceleration += self.params.magnus * np.cross(self.ball_spin, velocity)
                data.xfrc_applied[self._ball_body, :3] = BALL_MASS * acceleration
            before = velocity.copy()
            mujoco.mj_step(self.model, data)
            if data.ncon or self._touching:
                self._contacts(before)

    def _contacts(self, before: np.ndarray) -> None:
        """Tangential impulse at the first touch of each surface; robot against table is counted."""
        touching = set()
        for i in range(self.data.ncon):
            pair = set(self.data.contact.geom[i].tolist())
            if self._ball_geom in pair:
                other = (pair - {self._ball_geom}).pop()
                touching.add(other)
                if other not in self._touching:
                    self.touches.append((self.data.time, self.model.geom(other).name, self.ball))
                    self._grip(other, self.data.contact.frame[i, :3].copy(), self.data.contact.pos[i].copy(), before)
            else:
                self.collisions += 1
        self._touching = touching

    def _grip(self, surface: int, normal: np.ndarray, place: np.ndarray, before: np.ndarray) -> None:
        """dv = -alpha slip, by the velocity before the touch, with the spin that goes with it.

        alpha: by Coulomb on table and net, the rubber's gain on the paddle.
        """
        data = self.data
        if normal @ (self._position - place) < 0:
            normal = -normal
        blade = np.zeros(3)
        if surface == self._paddle_geom:
            motion = np.zeros(6)  # angular, linear
            mujoco.mj_objectVelocity(self.model, data, mujoco.mjtObj.mjOBJ_SITE, self._site, motion, 0)
            blade = motion[3:] + np.cross(motion[:3], place - data.site_xpos[self._site])
        spin = self.ball_spin
        slip = before + np.cross(spin, -BALL_RADIUS * normal) - blade
        normal_speed = slip @ normal
        slip -= normal * normal_speed
        alpha = self.params.rubber_gain
        if surface != self._paddle_geom:
            restitution, friction = self._surfaces[surface]
            limit = friction * (1.0 + restitution) * abs(normal_speed) / max(np.sqrt(slip @ slip), 1e-9)
            alpha = min(limit, STICKING)
        change = -alpha * slip
        self._velocity += change
        spin = spin - BALL_MASS * BALL_RADIUS / SHELL_INERTIA * np.cross(normal, change)
        self._body_spin[:] = self._rotation.T @ spin


def _model(scene: str, robot: mujoco.MjModel, params: WorldParams) -> mujoco.MjModel:
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, robot.site("paddle").quat)
    spec = mujoco.MjSpec.from_file(scene)
    spec.option.timestep = params.timestep
    spec.option.disableflags &= ~(mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    # Islands are solved by a second thread, for which a real-time process waits up to 80 ms at every contact.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    spec.delete(spec.body("ball"))
    ball = spec.worldbody.add_body(name="ball", pos=PARKED)
    ball.add_freejoint(name="ball_free")
    ball.mass, ball.inertia, ball.ipos = BALL_MASS, [SHELL_INERTIA] * 3, [0.0, 0.0, 0.0]
    ball.explicitinertial = True
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    ball.add_geom(name="ball", type=sphere, size=[BALL_RADIUS, 0, 0], contype=0, conaffinity=0, rgba=[1, 0.55, 0.1, 1])
    site = spec.site("paddle")
    hand = site.parent
    # The disc's axis is the site's z axis.
    half = rotation.reshape(3, 3)[:, 2] * PADDLE_HALF_THICKNESS
    centre = np.array(site.pos)
    hand.add_geom(
        name="rig_paddle",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        fromto=[*(centre - half), *(centre + half)],
        size=[PADDLE_RADIUS, 0, 0],
        contype=0,
        conaffinity=0,
        mass=0.0,
        group=3,
    )
    restitutions = {"col_table": params.table_restitution, "net": NET[0], "rig_paddle": params.paddle_restitution}
    for name, restitution in restitutions.items():
        damping = damping_for(restitution, STIFFNESS, params.timestep / FINE)
        spec.add_pair(geomname1="ball", geomname2=name, condim=1, solref=[-STIFFNESS, -damping], solimp=SOLIMP)
    for geom in spec.geoms:
        # The robot meets the table as a solid thing; what the safety layer prevents must be visible here if it fails.
        if geom.name == "col_table":
            geom.contype, geom.conaffinity = 1, 0
        elif geom.name.startswith("col_") and geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE:
            geom.contype, geom.conaffinity = 0, 1
    for key in spec.keys:  # their positions lack the ball's
        spec.delete(key)
    return spec.compile()


def damping_for(restitution: float, stiffness: float, timestep: float, speed: float = 5.0) -> float:
    """The contact's damping [1/s] that gives a ball dropped at ``speed`` [m/s] the wanted restitution, by bisection.

    Found by experiment in MuJoCo itself, so that its softness and the finite time step are in it. Where within a step
    the contact begins changes a single bounce by a few per cent: the mean over such phases counts.
    """
    model = _drops(timestep, speed)
    low, high = 0.0, 4.0 * np.sqrt(stiffness)
    for _ in range(20):
        middle = 0.5 * (low + high)
        model.pair_solref[:] = -stiffness, -middle
        data = mujoco.MjData(model)
        data.qvel[2::6] = -speed
        for _ in range(math.ceil((4.0 * CONTACT_TIME) / timestep)):
            mujoco.mj_step(model, data)
        if data.qvel[2::6].mean() / speed > restitution:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _drops(timestep: float, speed: float) -> mujoco.MjModel:
    """Balls above a plane at heights that differ by parts of a step's way."""
    bodies, pairs = "", ""
    for i in range(PHASES):
        height = BALL_RADIUS + (i + 0.5) / PHASES * speed * timestep
        bodies += f"""<body pos="{i} 0 {height}"><freejoint/><inertial pos="0 0 0" mass="{BALL_MASS}"
 diaginertia="{SHELL_INERTIA} {SHELL_INERTIA} {SHELL_INERTIA}"/>
<geom name="ball{i}" size="{BALL_RADIUS}" contype="0" conaffinity="0"/></body>"""
        pairs += f'<pair geom1="ball{i}" geom2="plane" condim="1" solimp="{" ".join(map(str, SOLIMP))}"/>'
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{timestep}" gravity="0 0 0" integrator="implicitfast"/><worldbody>
<geom name="plane" type="plane" size="9 9 1" contype="0" conaffinity="0"/>{bodies}</worldbody>
<contact>{pairs}</contact></mujoco>"""
    )
