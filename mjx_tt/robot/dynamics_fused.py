"""MuJoCo's implicitfast step of a serial chain, unrolled over the joints with the batch as the last axis.

The articulated-body algorithm (Featherstone, Rigid Body Dynamics Algorithms, 2008, table 7.1) in link frames. Every
scalar of the recursion is one array over the batch and constants are folded while tracing (``fold``), so the compiler
sees element-wise operations only and makes a few vector loops of them.

implicitfast solves (M + h D) qacc = forces with D the derivative of damping and actuator forces by velocity. Those act
on single joints here, so D is diagonal and h D is an addition to the armature: no factorisation is needed and the
result equals MuJoCo C's to rounding.
"""

from __future__ import annotations

import numpy as np

from mjx_tt.robot import scalar_algebra as f
from mjx_tt.robot.chain import Chain, Link
from mjx_tt.robot.kinematics import Controls, Joints, centred_on_anchors, joint_transforms, stack


class FusedEngine:
    """``step(qpos, qvel, ctrl) -> (qpos, qvel)`` for arrays (n, ...) of any batch shape, over ``timestep`` seconds."""

    name = "fused"

    def __init__(self, chain: Chain, timestep: float | None = None) -> None:
        self._chain = centred_on_anchors(chain)
        self.timestep = chain.timestep if timestep is None else timestep
        gravcomp = {link.gravcomp for link in chain.links if link.mass > 0.0}
        self._uniform_gravcomp = gravcomp.pop() if len(gravcomp) == 1 else None

    def step(self, qpos: Joints, qvel: Joints, ctrl: Controls) -> tuple[Joints, Joints]:
        """One step. qpos [m]/[rad], qvel [m/s]/[rad/s], ctrl in the actuators' units: each (n, ...)."""
        h = self.timestep
        acceleration = _articulated_body(self._chain, h, self._uniform_gravcomp, qpos, qvel, ctrl)
        qvel = qvel + h * stack(acceleration, qvel[0])
        return qpos + h * qvel, qvel


def _spatial_inertia(link: Link) -> tuple[f.Matrix, f.Matrix, f.Matrix]:
    """Rotational part about the link's origin, coupling m [c]x, mass: blocks of the 6 x 6 inertia as constants."""
    c = np.array(f.skew(link.com), float)
    about_origin = np.array(link.inertia) + link.mass * c @ c.T
    return f.matrix(about_origin), f.matrix(link.mass * c), f.matrix(link.mass * np.eye(3))


def _joint_force(link: Link, i: int, qpos: Joints, qvel: Joints, ctrl: Controls) -> f.Scalar:
    force = f.mul(link.bias_qvel - link.damping, qvel[i])
    if link.ctrl_index >= 0:
        force = f.add(force, f.mul(link.gain, ctrl[link.ctrl_index]))
    return f.add(f.add(force, f.mul(link.bias_qpos, qpos[i])), link.bias0)


# Symmetric matrices, each entry computed once.


def _less_outer(m: f.Matrix, a: f.Vector, b: f.Vector) -> f.Matrix:
    """m - a b^T where that is symmetric."""
    return f.mirror(lambda r, c: f.sub(m[r][c], f.mul(a[r], b[c])))


def _sum(a: f.Matrix, b: f.Matrix) -> f.Matrix:
    return f.mirror(lambda r, c: f.add(a[r][c], b[r][c]))


def _shifted(A: f.Matrix, PBt: f.Matrix, PC: f.Matrix, P: f.Matrix) -> f.Matrix:
    """A + P B^T + (P B^T)^T + P C P^T."""
    return f.mirror(lambda r, c: f.add(A[r][c], f.add(f.add(PBt[r][c], PBt[c][r]), f.dot(PC[r], P[c]))))


def _articulated_body(
    chain: Chain,
    h: float,
    uniform_gravcomp: float | None,
    qpos: Joints,
    qvel: Joints,
    ctrl: Controls,
) -> list[f.Scalar]:
    links, n = chain.links, len(chain.links)
    # By joint: articulated inertia (rotational, coupling and translational blocks), bias force (moment, force),
    # velocity-product acceleration.
    A: dict[int, f.Matrix] = {}
    B: dict[int, f.Matrix] = {}
    C: dict[int, f.Matrix] = {}
    pw: dict[int, f.Vector] = {}
    pv: dict[int, f.Vector] = {}
    cw: dict[int, f.Vector] = {}
    cv: dict[int, f.Vector] = {}
    rot, pos = zip(*joint_transforms(chain, qpos), strict=True)
    w_parent: f.Vector = f.ZERO3
    v_parent: f.Vector = f.ZERO3
    gravity: f.Vector = chain.gravity

    for i, link in enumerate(links):
        to_link = f.transpose(rot[i])
        w = f.matvec(to_link, w_parent)
        v = f.matvec(to_link, f.vadd(v_parent, f.cross(w_parent, pos[i])))
        joint_velocity = f.vscale(link.axis, qvel[i])
        if link.slide:
            cw[i], cv[i] = f.ZERO3, f.cross(w, joint_velocity)
            v = f.vadd(v, joint_velocity)
        else:
            cw[i], cv[i] = f.cross(w, joint_velocity), f.cross(v, joint_velocity)
            w = f.vadd(w, joint_velocity)
        A[i], B[i], C[i] = _spatial_inertia(link)
        moment = f.vadd(f.matvec(A[i], w), f.matvec(B[i], v))
        momentum = f.vadd(f.matvec(f.transpose(B[i]), w), f.vscale(v, link.mass))
        pw[i] = f.vadd(f.cross(w, moment), f.cross(v, momentum))
        pv[i] = f.cross(w, momentum)
        if uniform_gravcomp is None:  # else gravity enters once, as the base's acceleration
            gravity = f.matvec(to_link, gravity)
            weight = f.vscale(gravity, link.mass * (1.0 - link.gravcomp))
            pw[i] = f.vsub(pw[i], f.cross(link.com, weight))
            pv[i] = f.vsub(pv[i], weight)
        # The bias terms are used once or twice: computing them there costs less than storing them here.
        w, v, gravity = f.optimization_barrier((w, v, gravity))
        w_parent, v_parent = w, v

    U: dict[int, tuple[f.Vector, f.Vector]] = {}
    inverse_d: dict[int, f.Scalar] = {}
    u: dict[int, f.Scalar] = {}
    for i in reversed(range(n)):
        link = links[i]
        if link.slide:
            Uw, Uv = f.matvec(B[i], link.axis), f.matvec(C[i], link.axis)
            along, bias = f.dot(link.axis, Uv), f.dot(link.axis, pv[i])
        else:
            Uw, Uv = f.matvec(A[i], link.axis), f.matvec(f.transpose(B[i]), link.axis)
            along, bias = f.dot(link.axis, Uw), f.dot(link.axis, pw[i])
        d = f.add(along, link.armature + h * (link.damping - link.bias_qvel))
        U[i], inverse_d[i] = (Uw, Uv), 1.0 / d
        u[i] = f.sub(_joint_force(link, i, qpos, qvel, ctrl), bias)
        if i == 0:
            break
        Uwd, Uvd = f.vscale(Uw, inverse_d[i]), f.vscale(Uv, inverse_d[i])
        Aa = _less_outer(A[i], Uwd, Uw)
        Ba = f.msub(B[i], f.outer(Uwd, Uv))
        Ca = _less_outer(C[i], Uvd, Uv)
        force_w = f.vadd(pw[i], f.vadd(f.vadd(f.matvec(Aa, cw[i]), f.matvec(Ba, cv[i])), f.vscale(Uwd, u[i])))
        force_v = f.vadd(
            pv[i], f.vadd(f.vadd(f.matvec(f.transpose(Ba), cw[i]), f.matvec(Ca, cv[i])), f.vscale(Uvd, u[i]))
        )
        # To the parent's frame: rotate, then move the reference point by p with P = [p]x:
        # A' = A + P B^T + (P B^T)^T + P C P^T,  B' = B + P C
        R, P = rot[i], f.skew(pos[i])
        A2, C2 = f.congruence(R, Aa), f.congruence(R, Ca)
        B2 = f.matmul(f.matmul(R, Ba), f.transpose(R))
        PC, PBt = f.matmul(P, C2), f.matmul(P, f.transpose(B2))
        shifted = _shifted(A2, PBt, PC, P)
        A[i - 1] = _sum(A[i - 1], shifted)
        B[i - 1] = f.madd(B[i - 1], f.madd(B2, PC))
        C[i - 1] = _sum(C[i - 1], C2)
        moved = f.matvec(R, force_v)
        pw[i - 1] = f.vadd(pw[i - 1], f.vadd(f.matvec(R, force_w), f.cross(pos[i], moved)))
        pv[i - 1] = f.vadd(pv[i - 1], moved)
        A[i - 1], B[i - 1], C[i - 1], pw[i - 1], pv[i - 1] = f.optimization_barrier(
            (A[i - 1], B[i - 1], C[i - 1], pw[i - 1], pv[i - 1])
        )

    aw: f.Vector = f.ZERO3
    av: f.Vector = f.ZERO3 if uniform_gravcomp is None else f.vscale(gravity, -(1.0 - uniform_gravcomp))
    qacc: list[f.Scalar] = []
    for i, link in enumerate(links):
        to_link = f.transpose(rot[i])
        a_w = f.vadd(f.matvec(to_link, aw), cw[i])
        a_v = f.vadd(f.matvec(to_link, f.vadd(av, f.cross(aw, pos[i]))), cv[i])
        Uw, Uv = U[i]
        qacc.append(f.mul(f.sub(u[i], f.add(f.dot(Uw, a_w), f.dot(Uv, a_v))), inverse_d[i]))
        if link.slide:
            a_v = f.vadd(a_v, f.vscale(link.axis, qacc[i]))
        else:
            a_w = f.vadd(a_w, f.vscale(link.axis, qacc[i]))
        qacc[i] = f.optimization_barrier(qacc[i])
        aw, av = f.optimization_barrier((a_w, a_v)) if i % 2 else (a_w, a_v)  # storing every second is the cheapest
    return qacc
