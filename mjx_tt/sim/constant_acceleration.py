"""Covariance of a Kalman filter that assumes constant acceleration and is driven by a white jerk.

State: position, velocity, acceleration of one axis; axes share the covariance. Its six numbers are xx, xv, xa, vv, va,
aa, each a number or an array. Units are the caller's. Source: Bar-Shalom, Li and Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, section 6.2.
"""

from __future__ import annotations

from typing import Any, TypeAlias

Covariance: TypeAlias = Any  # six numbers, or an array of six rows


def predict_covariance(covariance: Covariance, h: Any, density: Any) -> Covariance:
    """The covariance after a time ``h``: F P F' + Q.

    Q = density h [h^4/20, h^3/8, h^2/6; ., h^2/3, h/2; ., ., 1], with the density of the jerk.
    """
    xx, xv, xa, vv, va, aa = covariance
    x0, x1, x2 = xx + h * xv + h**2 / 2.0 * xa, xv + h * vv + h**2 / 2.0 * va, xa + h * va + h**2 / 2.0 * aa
    v1, v2 = vv + h * va, va + h * aa
    return (
        x0 + h * x1 + h**2 / 2.0 * x2 + density * h**5 / 20.0,
        x1 + h * x2 + density * h**4 / 8.0,
        x2 + density * h**3 / 6.0,
        v1 + h * v2 + density * h**3 / 3.0,
        v2 + density * h**2 / 2.0,
        aa + density * h,
    )


def correct_covariance(covariance: Covariance, gains: Any, noise: Any) -> Covariance:
    """The covariance after a measurement of the position: (1 - K H) P.

    Args:
        covariance: before it.
        gains: K = P H' / (H P H' + noise) of position, velocity and acceleration.
        noise: variance of the measurement.
    """
    _, xv, xa, vv, va, aa = covariance
    k0, k1, k2 = gains
    return k0 * noise, (1.0 - k0) * xv, (1.0 - k0) * xa, vv - k1 * xv, va - k1 * xa, aa - k2 * xa
