"""Forces on a ball in flight: gravity, buoyancy, quadratic drag, Magnus lift, spin decay, wind.

acceleration = g (1 - buoyancy) - K_d |u| u + K_m (omega x u) / (1 + c S),   u = v - wind
K_d = C_d rho A / (2 m)                 (Abeyruwan et al. 2022, appendix "Details on Modeling Human Ball Distributions")
K_m = k rho A r / (2 m)                 from C_L = k S / (1 + c S) with the spin ratio S = r |omega| / |u|
d omega / dt = -spin_decay omega

The defaults are the paper's drag-only ball. The literature's k runs from 0.3 to 1.5, so it is a parameter to be
identified, not a constant; over a wide range of spins it falls, and c says how soon: ``SATURATING_LIFT`` was fitted to
1,597 shots with measured spin, whose constant k falls from 0.69 (S < 0.3) to 0.23 (S > 1). MJX cannot do this: it
has only the inertia-box fluid model and drops lift silently.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal, TypeAlias, get_args

import jax

from ballmodel import constants as c
from ballmodel.io.ranges import Within
from ballmodel.partial_params import optional
from ballmodel.vec import Scalars, Vec, Vector, cross, norm

Integrator: TypeAlias = Literal["paper", "midpoint"]  # acceleration at a step's start (the paper's), or at its middle
INTEGRATORS = get_args(Integrator)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FlightParams:
    """Parameters of free flight; every field is a scalar or has the batch shape of the balls."""

    drag_coefficient: Annotated[Scalars, Within(0.0, 5.0)] = c.DRAG_COEFFICIENT  # C_d
    magnus_coefficient: Annotated[Scalars, Within(-10.0, 10.0)] = 0.0  # k in C_L = k r |omega| / |u|
    lift_saturation: Annotated[Scalars, Within(0.0, 100.0)] | None = optional(0.0)  # c in C_L = k S / (1 + c S)
    spin_decay: Annotated[Scalars, Within(-10.0, 100.0, "1/s")] = 0.0  # [1/s]
    air_density: Annotated[Scalars, Within(0.0, 10.0, "kg/m^3")] = c.AIR_DENSITY  # [kg/m^3]
    mass: Annotated[Scalars, Within(0.0001, 0.1, "kg")] = c.BALL_MASS  # [kg]
    radius: Annotated[Scalars, Within(0.001, 0.1, "m")] = c.BALL_RADIUS  # [m]
    area: Annotated[Scalars, Within(1e-06, 0.1, "m^2")] = c.BALL_AREA  # [m^2] cross-section
    # fraction of gravity taken away; 0.0149 for a ball in air at 20 degC
    buoyancy: Annotated[Scalars, Within(-10.0, 10.0)] = 0.0
    gravity_x: Annotated[Scalars, Within(-100.0, 100.0, "m/s^2")] = 0.0  # [m/s^2]
    gravity_y: Annotated[Scalars, Within(-100.0, 100.0, "m/s^2")] = 0.0  # [m/s^2]
    gravity_z: Annotated[Scalars, Within(-100.0, 100.0, "m/s^2")] = -c.GRAVITY  # [m/s^2]
    wind_x: Annotated[Scalars, Within(-50.0, 50.0, "m/s")] = 0.0  # [m/s]
    wind_y: Annotated[Scalars, Within(-50.0, 50.0, "m/s")] = 0.0  # [m/s]
    wind_z: Annotated[Scalars, Within(-50.0, 50.0, "m/s")] = 0.0  # [m/s]
    integrator: Integrator = field(default="paper", metadata={"static": True})


# C_L = S / (0.55 + 3.55 S), with C_d = 0.33: landing errors of 68 mm in the median where the best constant k has 104.
SATURATING_LIFT = {"magnus_coefficient": 1 / 0.55, "lift_saturation": 3.55 / 0.55, "drag_coefficient": 0.33}


def drag_factor(params: FlightParams) -> Scalars:
    """K_d [1/m]."""
    return params.drag_coefficient * params.air_density * params.area / (2.0 * params.mass)


def magnus_factor(params: FlightParams) -> Scalars:
    """K_m [dimensionless]: acceleration is K_m (omega x u)."""
    return params.magnus_coefficient * params.air_density * params.area * params.radius / (2.0 * params.mass)


def acceleration(params: FlightParams, velocity: Vector, spin: Vector) -> Vec:
    """Acceleration [m/s^2] of a ball with velocity [m/s] and spin [rad/s], each a Vec or a (3, ...) array."""
    air = (params.wind_x, params.wind_y, params.wind_z)
    u = Vec(*(velocity[i] - air[i] for i in range(3)))
    drag = -drag_factor(params) * norm(u)
    lift = cross(spin, u) * magnus_factor(params)
    if params.lift_saturation is not None:
        speed = norm(u)
        saturated = speed + params.lift_saturation * params.radius * norm(Vec(*(spin[i] for i in range(3))))
        lift = lift * (speed / saturated)
    weight = (params.gravity_x, params.gravity_y, params.gravity_z)
    return Vec(*(weight[i] * (1.0 - params.buoyancy) + drag * u[i] + lift[i] for i in range(3)))
