"""Discrepancy: what no entry of the catalogue explains, as smooth functions that carry no name.

A family of functions is one of small extra forces, of kicks at the bounce or of shifts of the measured position. Its
effect on a measured flight follows from the flight's own transition matrix, bounce included, so nothing is simulated
again:
    dx(t) = Phi_x(t) sum over s < t of Phi(s)^-1 [0; a(s)] ds
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_tt.diagnosis.ball.flights.forward_model import Grid
from mjx_tt.diagnosis.ball.flights.linearization import Linear
from mjx_tt.diagnosis.inclusion import Family

DIRECTIONS = ("x", "y", "z", "along the flight")
FORCES = (0, 3, 2)  # directions of forces: along y and along the flight are nearly one
KNOTS = 4
# Ordinary amplitudes: a hundredth of gravity [m/s^2], a kick of a worn table's [m/s], a calibration's error [m].
USUAL = {"force": 0.1, "bounce": 0.1, "measured": 0.002}
Respond = Callable[[np.ndarray, int], np.ndarray]  # (profile (T, n) or kick (n,), direction) -> column (3, T, n)


def hats(
    value: Float[np.ndarray, "*shape"], mask: Bool[np.ndarray, "*shape"], knots: int = KNOTS
) -> tuple[Float[np.ndarray, "knots ..."], Float[np.ndarray, " k"]]:
    """Linear B-splines of a quantity between its 2nd and 98th percentile, and the knots."""
    low, high = np.percentile(value[mask], [2, 98])
    if high - low < 1e-9:
        return np.zeros((0, *value.shape)), np.zeros(0)
    places = np.linspace(low, high, knots)
    u = (np.clip(value, low, high) - low) / (high - low) * (knots - 1)
    return np.clip(1.0 - np.abs(u[None] - np.arange(knots).reshape((-1,) + (1,) * value.ndim)), 0.0, 1.0), places


def build(
    linear: Linear,
    g: Grid,
    sessions: Int[np.ndarray, " n"],
    age: Float[np.ndarray, " n"],
    called: Sequence[str],
    first: int,
) -> tuple[list[Family], Float[np.ndarray, "m 3 T n"]]:
    """All families, and their columns in metres for unit coefficients.

    sessions: number of each ball's session; age: 0 to 1, its place in its session; called: the sessions' names; first:
    number of the first column.
    """
    position, velocity = linear.base.position[:, :, 0], linear.base.velocity[:, :, 0]  # (3, T, n)
    speed = np.linalg.norm(velocity, axis=0)
    later = np.where(g.mask, g.time > linear.base.bounce_time[0], False).astype(float)
    response, kicked = _propagators(linear, g)
    families: list[Family] = []
    columns: list[np.ndarray] = []

    def family(
        name: str,
        basis: Iterable[np.ndarray],
        labels: Sequence[str],
        respond: Respond,
        along: Sequence[int] = (0, 1, 2),
    ) -> None:
        functions = list(basis)
        for d in along if functions else ():
            mine = first + len(columns) + np.arange(len(functions))
            families.append(Family(name, DIRECTIONS[d], mine, tuple(labels), USUAL[name.split()[0]]))
            columns.extend(respond(phi, d) for phi in functions)

    def spline(
        name: str,
        quantity: np.ndarray,
        unit: str,
        respond: Respond,
        knots: int = KNOTS,
        along: Sequence[int] = (0, 1, 2),
    ) -> None:
        basis, places = hats(quantity, g.mask, knots)
        family(name, basis, [f"{name.split(' over ')[1]} near {p:.2f} {unit}" for p in places], respond, along)

    ages = np.broadcast_to(age, g.time.shape)
    for name, quantity, unit in (
        ("x", position[0], "m"),
        ("y", position[1], "m"),
        ("z", position[2], "m"),
        ("speed", speed, "m/s"),
        ("session", ages, "of it"),
        ("flight", g.time, "s"),
    ):
        spline(f"force over {name}", quantity, unit, response, along=FORCES)
    for name, quantity, unit in (("x", position[0], "m"), ("y", position[1], "m"), ("z", position[2], "m")):
        spline(f"measured position over {name}", quantity, unit, _shift, 5)
    late = later[:, :] > 0.0
    if late.any():
        bx, by = linear.base.bounce[0, 0], linear.base.bounce[1, 0]
        vin = np.linalg.norm(linear.base.bounce_velocity[:, 0], axis=0)
        vz = -linear.base.bounce_velocity[2, 0]
        bounced = np.isfinite(linear.base.bounce_time[0])
        # What slows a ball along its way is no kick along y where balls come from both ends.
        ends = np.sign(linear.base.bounce_velocity[1, 0, bounced])
        axes = (0, 1, 2) if np.all(ends == ends[0]) else (0, 1, 2, 3)

        def over(name: str, value: np.ndarray, unit: str) -> None:
            basis, places = hats(np.where(bounced, value, np.nan_to_num(value[bounced].mean())), bounced)
            family(
                f"bounce over {name}",
                basis,
                [f"{name} near {p:.2f} {unit}" for p in places],
                kicked,
                axes,
            )

        over("x", bx, "m")
        over("y", np.abs(by), "m from the net")
        over("speed", vin, "m/s")
        over("vertical speed", vz, "m/s")
        over("time in the session", age, "of it")
        cells, labels = _cells(bx, by, bounced)
        family("bounce over the table", cells, labels, kicked, (2,))
    names = np.unique(sessions)
    if len(names) > 1:
        basis = np.stack([(sessions == s).astype(float) for s in names])
        wide = [np.broadcast_to(b, g.time.shape) for b in basis]
        labels = [f"session {called[s]}" for s in names]
        family("force by session", wide, labels, response, FORCES)
        if late.any():
            family("bounce by session", basis, labels, kicked)
    crossing = _crossing(position[1], g)
    if crossing.any():
        family("force at the net", [crossing], ["|y| < 0.15 m"], response, FORCES)
    return families, np.array(columns)


def _shift(phi: np.ndarray, d: int) -> np.ndarray:
    column = np.zeros((3, *phi.shape))
    column[d] = phi
    return column


def _cells(x: np.ndarray, y: np.ndarray, bounced: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Indicator of thirds across and along each half of the table, where enough balls land."""
    cells, labels = [], []
    for side in (-1.0, 1.0):
        on = bounced & (np.sign(y) == side)
        if on.sum() < 20:
            continue
        ex, ey = np.quantile(x[on], [0, 1 / 3, 2 / 3, 1]), np.quantile(y[on], [0, 1 / 3, 2 / 3, 1])
        for i in range(3):
            for j in range(3):
                cell = on & (x >= ex[i]) & (x <= ex[i + 1]) & (y >= ey[j]) & (y <= ey[j + 1])
                if cell.sum() >= 5:
                    cells.append(cell.astype(float))
                    labels.append(f"x {ex[i]:+.2f} to {ex[i + 1]:+.2f}, y {ey[j]:+.2f} to {ey[j + 1]:+.2f} m")
    return np.array(cells).reshape(-1, len(x)), labels


def _crossing(y: np.ndarray, g: Grid) -> np.ndarray:
    return np.where(g.mask & (np.abs(y) < 0.15), 1.0, 0.0)


def _propagators(linear: Linear, g: Grid) -> tuple[Respond, Respond]:
    """Functions that turn an acceleration profile (T, n) or a kick (n,) along an axis into a column (3, T, n)."""
    # Components first, balls last: (6, 6, T, n).
    inverse = np.ascontiguousarray(np.linalg.inv(linear.transition).transpose(2, 3, 1, 0))
    place = np.ascontiguousarray(linear.transition[:, :, :3].transpose(2, 3, 1, 0))
    velocity = linear.base.velocity[:, :, 0]
    way = velocity / np.maximum(np.linalg.norm(velocity, axis=0), 1e-9)
    dt = np.zeros_like(g.time)
    dt[1:] = np.diff(g.time, axis=0)
    bounce = linear.base.bounce_time[0]
    after = (g.time > bounce[None]) & g.mask  # (T, n)

    # Phi^-1 of a unit impulse along each axis and along the flight, (6, T, n) each. It acts on average half an interval
    # before the sample.
    impulse = inverse[:, 3:] + 0.5 * dt * inverse[:, :3]
    pushed = [impulse[:, 0], impulse[:, 1], impulse[:, 2], (impulse * way).sum(axis=1)]

    def carried(source: np.ndarray) -> np.ndarray:
        """Sum over earlier samples of what Phi^-1 left of them (6, T, n), carried on."""
        return (place * np.cumsum(source, axis=1)).sum(axis=1)

    def response(phi: np.ndarray, d: int) -> np.ndarray:
        profile = np.where(g.mask, phi, 0.0)
        mean = np.zeros_like(profile)
        mean[1:] = 0.5 * (profile[1:] + profile[:-1]) * dt[1:]
        return carried(pushed[d] * mean)

    since = g.time - np.where(np.isfinite(bounce), bounce, 0.0)[None]
    first = after & (np.cumsum(after, axis=0) == 1)
    impact = linear.base.bounce_velocity[:2, 0]
    along = impact / np.maximum(np.linalg.norm(impact, axis=0), 1e-9)  # over the table
    kicks = [carried(np.where(first, inverse[:, 3 + d] + since * inverse[:, d], 0.0)) for d in range(3)]
    kicks.append(along[0] * kicks[0] + along[1] * kicks[1])

    def kicked(size: np.ndarray, d: int) -> np.ndarray:
        return kicks[d] * size

    return response, kicked
