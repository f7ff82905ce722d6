"""Camera poses, lenses and clocks from table lines and flights, by least squares with what is known beforehand.

Every parameter has a prior: the deviation with which a new rig's YAML is right. What the data leave as uncertain as it
was is not determined; then the prior stays, and the report says so, or the calibration is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ballmodel.kalman import Physics, move
from experiments.vision.calibration.edges import SIDES, Edges, find_edges
from robot_io.vision.camera import Camera
from robot_io.vision.rig import CameraRig
from robot_io.vision.tracker import PHYSICS
from robot_io.vision.triangulation import intersect

REACHES = (80.0, 25.0, 8.0, 4.0)  # [px] of the search for lines, one after the other
EDGE, PIXEL = 0.5, 0.3  # [px] deviations of a line's and of a ball's place
# Deviations of a camera's parameters beforehand: turn [rad], centre [m], logarithm of the focal length, k1.
PRIOR = np.array([0.1] * 3 + [0.3] * 3 + [0.02, 0.05])
UNIT = np.array([0.01] * 3 + [0.02] * 3 + [0.02, 0.05])
SKEW = 0.005  # [s]
DRAG = 0.03  # [1/m]
STATE = np.array([0.05] * 3 + [0.3] * 3 + [60.0] * 3)  # deviations of flights' states from their first guess
DETERMINED = 0.5  # share of a prior's deviation that the data must at least leave
FEWEST_SIDES, FEWEST_POINTS = 3, 60
LARGEST_RESIDUAL = 1.5  # [px] root mean square


def adjust(camera: Camera, change: np.ndarray) -> Camera:
    """A camera turned by (3,) [rad] and shifted by (3,) [m], its focal length times exp of a number, k1 plus one (8,)."""
    matrix, distortion = camera.matrix.copy(), camera.distortion.copy()
    matrix[[0, 1], [0, 1]] *= np.exp(change[6])
    distortion[0] += change[7]
    turned = camera.moved(Rotation.from_rotvec(change[:3]).as_matrix(), change[3:6])
    return replace(turned, matrix=matrix, distortion=distortion)


def fit_edges(picture: np.ndarray, guess: Camera, lens: bool = True) -> tuple[Camera, Edges]:
    """The camera whose table lies on a picture's lines; the search begins 80 px around a guess's and narrows.

    Args:
        picture: (h, w) grey.
        guess: about where it is.
        lens: also fit focal length and k1.

    Raises:
        ValueError: fewer than three sides are found, or they do not fit a table.
    """
    camera = guess
    for reach in REACHES:
        edges = find_edges(picture, camera, reach)
        found = np.bincount(edges.sides, minlength=len(SIDES)) > 0
        if found.sum() < FEWEST_SIDES or len(edges.points) < FEWEST_POINTS:
            raise ValueError(
                f"camera {guess.name}: expected three of the table's sides, got "
                f"{', '.join(s for s, f in zip(SIDES, found, strict=True) if f) or 'none'} ({len(edges.points)} points); "
                "correct its position and rotation in the rig's YAML until they are right to a few centimetres and "
                "degrees, and clear the table"
            )
        free = slice(8) if lens and reach < 80.0 else slice(6)

        def residuals(x: np.ndarray, edges: Edges = edges, free: slice = free) -> np.ndarray:
            change = np.zeros(8)
            change[free] = x * UNIT[free]
            moved = adjust(camera, change)
            away = np.nan_to_num(edges.residuals(moved), nan=1e3) / EDGE
            lens_change = [np.log(moved.matrix[0, 0] / guess.matrix[0, 0]), moved.distortion[0] - guess.distortion[0]]
            return np.concatenate([away, lens_change / PRIOR[6:]])

        count = 8 if lens and reach < 80.0 else 6
        solved = least_squares(residuals, np.zeros(count), loss="soft_l1", f_scale=3.0)
        change = np.zeros(8)
        change[free] = solved.x * UNIT[free]
        camera = adjust(camera, change)
    rms = float(np.sqrt(np.mean(edges.residuals(camera) ** 2)))
    if rms > LARGEST_RESIDUAL:
        raise ValueError(
            f"camera {guess.name}: expected lines within {LARGEST_RESIDUAL} px of a table's, got {rms:.1f} px; is the "
            "lens's k1 far off, or the table no standard one?"
        )
    return camera, edges


@dataclass(frozen=True, eq=False)
class Flight:
    """Free flight of a ball as each camera saw it.

    times   (n,) [s] of the first camera's clock, from 0
    pixels  (cameras, n, 2); NaN where it was not seen
    """

    times: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A calibration.

    rig         with poses, lenses, delays and residuals
    deviations  by name, of each camera's parameters: turn, centre, focal, k1; and of its delay [s]
    undetermined  names of what the data do not say, and that stays as it was
    flights     that were used
    drag        [1/m]
    """

    rig: CameraRig
    deviations: dict[str, float]
    undetermined: tuple[str, ...]
    flights: int
    drag: float


def fit_rig(rig: CameraRig, edges: Sequence[Edges], flights: Sequence[Flight], bumped: str | None = None) -> Calibrated:
    """Cameras from lines and flights together.

    Args:
        rig: as the lines alone give it.
        edges: of each camera.
        flights: at least three, or none: then delays stay.
        bumped: name of the only camera whose pose changed; its lens and all the others stay.

    Raises:
        ValueError: the flights do not fit, or too few of them are given.
    """
    if 0 < len(flights) < 3:
        raise ValueError(
            f"expected at least 3 free flights that two cameras see, got {len(flights)}; record more balls"
        )
    count = len(rig.cameras)
    problem = _Problem(rig, tuple(edges), tuple(flights), bumped)
    x = problem.start
    solved = least_squares(problem.residuals, x, x_scale="jac", loss="soft_l1", f_scale=3.0, max_nfev=30)
    # The Jacobian of the robust cost is scaled; its normal matrix holds the priors, which are residuals too.
    covariance = np.linalg.pinv(solved.jac.T @ solved.jac)
    scale = problem.scale
    deviation = np.sqrt(np.diag(covariance)) * scale
    cameras, delays, drag, _ = problem.parts(solved.x)
    deviations, undetermined = {}, []
    for k, value in enumerate(problem.free):
        name, prior = problem.names[value], problem.prior[value]
        deviations[name] = float(deviation[k])
        if deviation[k] > DETERMINED * prior:
            undetermined.append(name)
    residuals = []
    for i in range(count):
        away = [edges[i].residuals(cameras[i])]
        if flights:
            away.append(problem.away(solved.x, i).ravel())
        each = np.concatenate(away)
        residuals.append(float(np.sqrt(np.nanmean(np.minimum(each**2, 9.0)))))
    if max(residuals) > LARGEST_RESIDUAL:
        raise ValueError(
            f"expected residuals within {LARGEST_RESIDUAL} px, got {max(residuals):.2f}; nothing was changed"
        )
    fitted = replace(rig, cameras=tuple(cameras), delays=tuple(delays), residuals=tuple(residuals))
    return Calibrated(fitted, deviations, tuple(undetermined), len(flights), drag)


class _Problem:
    """Parameters, their priors, and residuals: of lines, of flights, and of the priors."""

    def __init__(
        self, rig: CameraRig, edges: tuple[Edges, ...], flights: tuple[Flight, ...], bumped: str | None
    ) -> None:
        self._rig, self._edges, self._flights = rig, edges, flights
        count = len(rig.cameras)
        kinds = ("turn x", "turn y", "turn z", "centre x", "centre y", "centre z", "focal", "k1")
        self.names = [f"{camera.name}: {kind}" for camera in rig.cameras for kind in kinds]
        self.names += [f"{camera.name}: delay" for camera in rig.cameras[1:]] + ["drag"]
        self.prior = np.concatenate([np.tile(PRIOR, count), np.full(count - 1, SKEW), [DRAG]])
        unit = np.concatenate([np.tile(UNIT, count), np.full(count - 1, 1e-3), [DRAG]])
        free = [i for i in range(8 * count) if bumped is None or (rig.cameras[i // 8].name == bumped and i % 8 < 6)]
        if flights and bumped is None:
            free += range(8 * count, 9 * count)
        self.free = np.array(free)
        self._unit = unit
        self._first = self._first_states()
        self.scale = np.concatenate([unit[self.free], np.tile(STATE, len(flights))])
        self.start = np.zeros(len(self.scale))
        self._longest = max((len(f.times) for f in flights), default=0)

    def parts(self, x: np.ndarray) -> tuple[list[Camera], list[float], float, np.ndarray]:
        """Cameras, delays, drag and states (9, flights)."""
        count = len(self._rig.cameras)
        change = np.zeros(len(self._unit))
        change[self.free] = x[: len(self.free)] * self._unit[self.free]
        cameras = [adjust(c, change[8 * i : 8 * i + 8]) for i, c in enumerate(self._rig.cameras)]
        delays = [
            self._rig.delays[0],
            *(d + c for d, c in zip(self._rig.delays[1:], change[8 * count : -1], strict=True)),
        ]
        states = self._first + (x[len(self.free) :].reshape(-1, 9) * STATE).T
        return cameras, delays, PHYSICS.drag + float(change[-1]), states

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """All, over their deviations."""
        cameras = self.parts(x)[0]
        out = [np.nan_to_num(e.residuals(c), nan=1e3) / EDGE for e, c in zip(self._edges, cameras, strict=True)]
        out.append(x[: len(self.free)] * self._unit[self.free] / self.prior[self.free])
        if self._flights:
            out += [np.nan_to_num(self.away(x, i)).ravel() / PIXEL for i in range(len(cameras))]
            out.append((x[len(self.free) :].reshape(-1, 9)[:, 6:]).ravel())
        return np.concatenate(out)

    def away(self, x: np.ndarray, camera: int) -> np.ndarray:
        """Flights' projections less what a camera saw (flights, n, 2) [px]; NaN where it saw nothing."""
        cameras, delays, drag, states = self.parts(x)
        physics = replace(PHYSICS, drag=drag)
        # A stamp t of this camera was taken at t + its delay; the tracks' times have the rig's present delays in them.
        late = delays[camera] - self._rig.delays[camera]
        out = np.full((len(self._flights), self._longest, 2), np.nan)
        places = fly(states, self._flights, late, physics)
        for k, flight in enumerate(self._flights):
            n = len(flight.times)
            out[k, :n] = cameras[camera].project(places[k, :n]) - flight.pixels[camera]
        return out

    def _first_states(self) -> np.ndarray:
        """States (9, flights) from rays that nearly meet, and a parabola through them."""
        first = np.zeros((9, len(self._flights)))
        cameras = self._rig.cameras[:2]
        centres = np.stack([c.centre for c in cameras])
        for k, flight in enumerate(self._flights):
            seen = np.isfinite(flight.pixels[:2]).all((0, 2))
            rays = np.stack([c.rays(p[seen]) for c, p in zip(cameras, flight.pixels[:2], strict=True)], 1)
            places, times = intersect(centres, rays), flight.times[seen]
            basis = np.stack([np.ones_like(times), times, 0.5 * times**2], 1)
            first[:6, k] = np.linalg.lstsq(basis, places, rcond=None)[0][:2].ravel()
        return first


def fly(states: np.ndarray, flights: Sequence[Flight], late: float, physics: Physics) -> np.ndarray:
    """Places (flights, n, 3) of states (9, flights) at the flights' times, each ``late`` [s] later."""
    longest = max(len(f.times) for f in flights)
    times = np.stack([np.pad(f.times, (0, longest - len(f.times)), mode="edge") for f in flights]) + late
    out, before = np.empty((*times.shape, 3)), np.zeros(len(flights))
    for k in range(longest):
        states, before = move(states, times[:, k] - before, physics), times[:, k]
        out[:, k] = states[:3].T
    return out
