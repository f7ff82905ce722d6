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
FEWEST_SIDES, FEWEST_POINTS, FEWEST_FLIGHTS = 3, 60, 3
LARGEST_RESIDUAL = 1.5  # [px] root mean square


def adjust(camera: Camera, change: np.ndarray) -> Camera:
    """A camera turned (3,) [rad] and shifted (3,) [m], its focal length times exp of a number, and k1 plus one."""
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

    def change(camera: Camera, x: np.ndarray) -> Camera:
        return adjust(camera, np.pad(x * UNIT[: len(x)], (0, len(UNIT) - len(x))))

    def residuals(x: np.ndarray, camera: Camera, edges: Edges) -> np.ndarray:
        moved = change(camera, x)
        away = np.nan_to_num(edges.residuals(moved), nan=1e3) / EDGE
        lens_change = [np.log(moved.matrix[0, 0] / guess.matrix[0, 0]), moved.distortion[0] - guess.distortion[0]]
        return np.concatenate([away, lens_change / PRIOR[6:]])

    camera = guess
    for reach in REACHES:
        edges = find_edges(picture, camera, reach)
        found = np.bincount(edges.sides, minlength=len(SIDES)) > 0
        if found.sum() < FEWEST_SIDES or len(edges.points) < FEWEST_POINTS:
            names = ", ".join(side for side, there in zip(SIDES, found, strict=True) if there) or "none"
            raise ValueError(
                f"camera {guess.name}: expected three of the table's sides, got {names} ({len(edges.points)} points); "
                "correct its position and rotation in the rig's YAML until they are right to a few centimetres and "
                "degrees, and clear the table"
            )
        start = np.zeros(8 if lens and reach < REACHES[0] else 6)
        solved = least_squares(residuals, start, loss="soft_l1", f_scale=3.0, args=(camera, edges))
        camera = change(camera, solved.x)
    rms = float(np.sqrt(np.mean(edges.residuals(camera) ** 2)))
    if rms > LARGEST_RESIDUAL:
        raise ValueError(
            f"camera {guess.name}: expected lines within {LARGEST_RESIDUAL} px of a table's, got {rms:.1f} px; is the "
            "lens's k1 far off, or the table no standard one?"
        )
    return camera, edges


def see_edges(picture: np.ndarray, camera: Camera) -> tuple[Camera, Edges]:
    """A camera that stands as it stood, and the lines that it sees. Raises ValueError where they are elsewhere."""
    edges = find_edges(picture, camera, REACHES[-1])
    away = edges.residuals(camera)
    if len(away) < FEWEST_POINTS or float(np.sqrt(np.mean(away**2))) > LARGEST_RESIDUAL:
        raise ValueError(
            f"camera {camera.name}: expected it to stand as calibrated, but the table's lines are elsewhere"
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
    if 0 < len(flights) < FEWEST_FLIGHTS:
        raise ValueError(
            f"expected at least {FEWEST_FLIGHTS} free flights that two cameras see, got {len(flights)}; "
            "record more balls"
        )
    problem = _Problem(rig, edges, flights, bumped)
    x, jacobian = problem.solve()
    if flights:
        rms = np.sqrt(np.nanmean(problem.away(x) ** 2, axis=(0, 2, 3)))  # [px] of each flight
        keep = rms <= max(1.0, 3.0 * float(np.median(rms)))  # the net, a hand, or another ball
        if not keep.all() and keep.sum() >= FEWEST_FLIGHTS:
            flights = [flight for flight, kept in zip(flights, keep, strict=True) if kept]
            problem = _Problem(rig, edges, flights, bumped)
            x, jacobian = problem.solve()
    # The normal matrix holds the priors, which are residuals too.
    deviation = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian))) * problem.scale
    cameras, delays, drag, _ = problem.parts(x)
    own = {problem.names[i]: (float(v), problem.prior[i]) for i, v in zip(problem.free, deviation, strict=False)}
    undetermined = tuple(name for name, (value, prior) in own.items() if value > DETERMINED * prior)
    residuals = []
    for camera, seen, flown in zip(cameras, edges, problem.away(x), strict=True):
        away = np.concatenate([seen.residuals(camera), flown.ravel()])
        residuals.append(float(np.sqrt(np.nanmean(np.minimum(away**2, 9.0)))))
    if max(residuals) > LARGEST_RESIDUAL:
        raise ValueError(
            f"expected residuals within {LARGEST_RESIDUAL} px, got {max(residuals):.2f}; nothing was changed"
        )
    fitted = replace(rig, cameras=tuple(cameras), delays=tuple(delays), residuals=tuple(residuals))
    deviations = {name: value for name, (value, _) in own.items()}
    return Calibrated(fitted, deviations, undetermined, len(flights), drag)


class _Problem:
    """Parameters, their priors, and residuals: of lines, of flights, and of the priors."""

    def __init__(self, rig: CameraRig, edges: Sequence[Edges], flights: Sequence[Flight], bumped: str | None) -> None:
        self._rig, self._edges, self._flights = rig, edges, tuple(flights)
        count = len(rig.cameras)
        kinds = ("turn x", "turn y", "turn z", "centre x", "centre y", "centre z", "focal", "k1")
        self.names = [f"{camera.name}: {kind}" for camera in rig.cameras for kind in kinds]
        self.names += [f"{camera.name}: delay" for camera in rig.cameras[1:]] + ["drag"]
        self.prior = np.concatenate([np.tile(PRIOR, count), np.full(count - 1, SKEW), [DRAG]])
        self._unit = np.concatenate([np.tile(UNIT, count), np.full(count - 1, 1e-3), [DRAG]])
        free = [i for i in range(8 * count) if bumped is None or (rig.cameras[i // 8].name == bumped and i % 8 < 6)]
        if flights and bumped is None:
            free += range(8 * count, 9 * count)
        self.free = np.array(free)
        self._first = self._first_states()
        self.scale = np.concatenate([self._unit[self.free], np.tile(STATE, len(flights))])

    def parts(self, x: np.ndarray) -> tuple[list[Camera], list[float], float, np.ndarray]:
        """Cameras, delays, drag and states (9, flights)."""
        count = len(self._rig.cameras)
        change = np.zeros(len(self._unit))
        change[self.free] = x[: len(self.free)] * self._unit[self.free]
        cameras = [adjust(c, change[8 * i : 8 * i + 8]) for i, c in enumerate(self._rig.cameras)]
        delays = [d + c for d, c in zip(self._rig.delays, (0.0, *change[8 * count : -1]), strict=True)]
        states = self._first + (x[len(self.free) :].reshape(-1, 9) * STATE).T
        return cameras, delays, PHYSICS.drag + float(change[-1]), states

    def solve(self) -> tuple[np.ndarray, np.ndarray]:
        """Solution and Jacobian, heavy tails taken lightly."""
        start = np.zeros(len(self.scale))
        found = least_squares(
            self.residuals, start, self.jacobian, x_scale="jac", loss="soft_l1", f_scale=3.0, max_nfev=40
        )
        return found.x, self.jacobian(found.x)

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """All, over their deviations; those of flights last, flight by flight."""
        cameras = self.parts(x)[0]
        out = [np.nan_to_num(e.residuals(c), nan=1e3) / EDGE for e, c in zip(self._edges, cameras, strict=True)]
        out.append(x[: len(self.free)] * self._unit[self.free] / self.prior[self.free])
        if self._flights:
            away = np.nan_to_num(self.away(x)).transpose(1, 0, 2, 3).reshape(len(self._flights), -1) / PIXEL
            out.append(np.concatenate([away, x[len(self.free) :].reshape(-1, 9)], 1).ravel())
        return np.concatenate(out)

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """By differences; the flights' states, each of which moves only its own flight, all at once."""
        base, small, own, count = self.residuals(x), 1e-5, len(self.free), len(self._flights)
        shared = sum(len(e.points) for e in self._edges) + own  # residuals that belong to no flight
        out = np.zeros((len(base), len(x)))
        for i in range(own):
            moved = x.copy()
            moved[i] += small
            out[:, i] = (self.residuals(moved) - base) / small
        rows = (len(base) - shared) // max(count, 1)
        for j in range(9 if count else 0):
            moved = x.copy()
            moved[own + j :: 9] += small
            change = (self.residuals(moved) - base) / small
            for k in range(count):
                part = slice(shared + k * rows, shared + (k + 1) * rows)
                out[part, own + 9 * k + j] = change[part]
        return out

    def away(self, x: np.ndarray) -> np.ndarray:
        """Flights' projections less what each camera saw (cameras, flights, n, 2) [px]; NaN where it saw nothing."""
        cameras, delays, drag, states = self.parts(x)
        physics, count = replace(PHYSICS, drag=drag), len(self._flights)
        out = np.full((len(cameras), count, max((len(f.times) for f in self._flights), default=0), 2), np.nan)
        if not count:
            return out
        # A camera whose delay is larger took its frames later than the flights' times say, by as much.
        late = np.repeat(np.array(delays) - np.array(self._rig.delays), count)
        places = fly(np.tile(states, len(cameras)), self._flights * len(cameras), late, physics)
        for i, camera in enumerate(cameras):
            for k, flight in enumerate(self._flights):
                n = len(flight.times)
                out[i, k, :n] = camera.project(places[i * count + k, :n]) - flight.pixels[i]
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


def fly(states: np.ndarray, flights: Sequence[Flight], late: np.ndarray, physics: Physics) -> np.ndarray:
    """Places (flights, n, 3) of states (9, flights) at the flights' times, each ``late`` (flights,) [s] later."""
    longest = max(len(f.times) for f in flights)
    times = np.stack([np.pad(f.times, (0, longest - len(f.times)), mode="edge") for f in flights]) + late[:, None]
    out, before = np.empty((*times.shape, 3)), np.zeros(len(flights))
    for k in range(longest):
        states, before = move(states, times[:, k] - before, physics), times[:, k]
        out[:, k] = states[:3].T
    return out
