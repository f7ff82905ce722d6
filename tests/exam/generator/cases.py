"""Hidden cases: what is wrong, how much, under which noise; drawn from a seed, scaled to a size in millimetres."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from tests.exam.generator import robot
from tests.exam.generator.human_strokes import draw_human
from tests.exam.generator.invented_defects import INVENTED
from tests.exam.generator.kalman_tracker import lag, tracked
from tests.exam.generator.sessions import NOISES, WRONG_NOISES, Balls, Log, draw_balls, measure, shift, with_spin
from tests.exam.generator.world import World

MAGNUS = 0.6  # k of a ball that curves
SCALING_BALLS, SCALING_ROUNDS = 80, 5
LEAST_LAG = 0.005  # [m] of a Kalman filter that is worth a name


@dataclass(frozen=True)
class Effect:
    """A catalogue effect as this generator understands it.

    field, rule: the World's number and what an amount ``a`` makes of it
    amount: of about 10 mm; signs: allowed ones
    twins: names that no ball log can tell apart from it
    truth: amount -> value for every model path that expresses the effect, the twins' included
    """

    field: str
    rule: Callable[[float, float], float]
    amount: float
    truth: Callable[[float], dict[str, float]]
    signs: tuple[int, ...] = (-1, 1)
    twins: tuple[str, ...] = ()


def _plus(value, a):
    return value + a


def _times(value, a):
    return value * (1.0 + a)


def _drag(a):
    f = "ball.flight."
    return {f + "drag_coefficient": 0.47 * (1 + a), f + "air_density": 1.29 * (1 + a), f + "mass": 0.0027 / (1 + a)}


def _gravity(a):
    return {
        "ball.flight.gravity_z": -9.81 * (1 + a),
        "ball.flight.buoyancy": -a,
        "sensing.clock_rate": (1 + a) ** -0.5,
    }


def _one(path, base=0.0):
    return lambda a: {path: base + a}


_DRAG = ("drag_coefficient", "air_density", "ball_mass")
_GRAVITY = ("gravity_scale", "clock_rate", "buoyancy")
_TILT_X = ("gravity_tilt_x", "camera_rotation_y", "table_tilt_x")
_TILT_Y = ("gravity_tilt_y", "camera_rotation_x", "table_tilt_y")
_BOUNCE = ("table_restitution", "table_restitution_speed")


def _others(names, name):
    return tuple(n for n in names if n != name)


def _drag_effect(name, number, rule):
    return Effect(number, rule, 0.02, _drag, twins=_others(_DRAG, name))


def _gravity_effect(name, number, rule, signs=(-1, 1)):
    return Effect(number, rule, 0.008, _gravity, signs, _others(_GRAVITY, name))


EFFECTS: dict[str, Effect] = {
    "drag_coefficient": _drag_effect("drag_coefficient", "drag_coefficient", _times),
    "air_density": _drag_effect("air_density", "air_density", _times),
    "ball_mass": _drag_effect("ball_mass", "mass", lambda m, a: m / (1 + a)),
    "magnus": Effect("magnus_coefficient", lambda k, a: MAGNUS, 4.0, lambda a: {}, (1,)),
    "wind_x": Effect("wind_x", _plus, 0.12, _one("ball.flight.wind_x")),
    "wind_y": Effect("wind_y", _plus, 0.07, _one("ball.flight.wind_y")),
    "wind_z": Effect("wind_z", _plus, 0.12, _one("ball.flight.wind_z")),
    "gravity_tilt_x": Effect("gravity_x", _plus, 0.08, _one("ball.flight.gravity_x")),
    "gravity_tilt_y": Effect("gravity_y", _plus, 0.08, _one("ball.flight.gravity_y")),
    "gravity_scale": _gravity_effect("gravity_scale", "gravity_z", _times),
    "buoyancy": _gravity_effect("buoyancy", "buoyancy", lambda b, a: b - a, (-1,)),
    "clock_rate": _gravity_effect("clock_rate", "clock_rate", lambda c, a: c * (1 + a) ** -0.5),
    # A ball that gains energy at the table does not exist: only less restitution, and less of it at speed.
    "table_restitution": Effect(
        "restitution",
        _plus,
        0.015,
        _one("ball.table.restitution", 0.93),
        (-1,),
    ),
    "table_restitution_speed": Effect("restitution_slope", _plus, 0.005, _one("ball.table.restitution_slope"), (1,)),
    "table_friction": Effect("friction", _plus, 0.03, _one("ball.table.friction", 0.25)),
    "table_height": Effect("height", _plus, 0.005, _one("ball.table.height")),
    "table_tilt_x": Effect("tilt_x", _plus, 0.006, _one("ball.table.tilt_x")),
    "table_tilt_y": Effect("tilt_y", _plus, 0.006, _one("ball.table.tilt_y")),
    "camera_scale": Effect("camera_scale", _plus, 0.01, _one("sensing.camera_scale", 1.0)),
    "camera_rotation_x": Effect("camera_rotation_x", _plus, 0.004, _one("sensing.camera_rotation_x")),
    "camera_rotation_y": Effect("camera_rotation_y", _plus, 0.004, _one("sensing.camera_rotation_y")),
    "camera_distortion": Effect("camera_distortion", _plus, 0.004, _one("sensing.camera_distortion")),
    "latency_jitter": Effect("jitter", _plus, 0.005, _one("sensing.jitter"), (1,)),
    "tracker_smoothing": Effect("smoothing", _plus, 0.008, _one("sensing.smoothing"), (1,)),
}
# Pairs whose effects on a log, the balls' states projected out, have a cosine above 0.97, measured with the generator's
# own physics. One of a pair in place of the other is a twin as the data can tell it.
LOOKALIKES = (
    ("wind_x", "gravity_tilt_x"),
    ("wind_y", "gravity_tilt_y"),
    ("table_restitution", "table_restitution_speed"),
    ("table_tilt_y", "camera_rotation_x"),
)
# Of a pair, one member of each family at most: two that look alike make one case of the other.
FAMILIES = (
    _DRAG,
    (*_GRAVITY, "camera_scale", "wind_z"),
    _TILT_X,
    _TILT_Y,
    (*_BOUNCE, "table_height"),
    ("tracker_smoothing",),
    ("latency_jitter",),
)

# Robot effects: number of Joint, drawn range at full excitation, relative to the joint's stroke speed where marked.
ROBOT_EFFECTS: dict[str, tuple[float, float]] = {
    "action_delay": (0.005, 0.025),  # [s] added
    "observation_delay": (0.005, 0.025),
    "lag": (0.010, 0.050),  # [s]
    "velocity_gain": (0.03, 0.15),  # relative, either sign
    "velocity_limit": (0.5, 0.8),  # of the fastest command
    "acceleration_limit": (8.0, 16.0),  # [1/s] times the joint's stroke speed
    "backlash": (0.002, 0.006),  # [m], [rad]
    "coulomb_friction": (0.01, 0.04),  # of the joint's stroke speed
    "deadband": (0.03, 0.08),
}


@dataclass(frozen=True)
class Case:
    """One hidden case; everything follows from these numbers.

    kind: none, noise (nothing but the noise is wrong), single, pair, triple, gauge, deleted, invented, many (2 to 8
        causes of ordinary sizes), bounce (60 balls on a table of another restitution and friction, far off), kalman,
        robot, unexcited, robot_none; human_none, human_single ... where people play
    causes: catalogue names, a name of INVENTED, or <joint>.<effect>
    without: names that the diagnosis may not use
    """

    kind: str
    causes: tuple[str, ...] = ()
    size_mm: float = 0.0
    noise: str = "iid"
    seed: int = 0
    without: tuple[str, ...] = ()
    count: int | None = None  # balls; None draws 200 to 500

    @property
    def human(self) -> bool:
        """True where people play: every ball spins, under a Magnus force that the nominal model has."""
        return self.kind.startswith("human_")

    @property
    def base(self) -> str:
        """The kind, whoever plays."""
        return self.kind.removeprefix("human_")

    @property
    def name(self) -> str:
        causes = "+".join(self.causes) or "nothing"
        return f"{self.kind}-{causes}-{self.size_mm:g}mm-{self.noise}-{self.seed}".replace("--", "-")


@dataclass(frozen=True)
class BallCase:
    """A drawn case: the world, its balls with their spins, and how much of each cause there is."""

    case: Case
    world: World
    balls: Balls
    amounts: dict[str, float]
    spin_mean: np.ndarray = field(default_factory=lambda: np.zeros(3))  # (3,) [rad/s] of balls that fly towards -y
    spin_std: np.ndarray = field(default_factory=lambda: np.zeros(3))
    filter: tuple[float, float] | None = None  # jerk and gate of the tracker's Kalman filter

    def log(self) -> Log:
        log = measure(self.world, self.balls, self.case.noise, _generator(self.case, "noise"))
        return log if self.filter is None else replace(log, position=tracked(log.position, *self.filter))

    def truth(self) -> dict:
        """Sealed content: the case, the accepted answers, and the values on every model path that expresses them."""
        values: dict[str, float] = {}
        for cause, amount in self.amounts.items():
            if cause in EFFECTS:
                values |= EFFECTS[cause].truth(amount)
        return {
            "case": asdict(self.case),
            "amounts": self.amounts,
            "parameters": values,
            "spin": {"k": MAGNUS, "mean": self.spin_mean.tolist(), "std": self.spin_std.tolist()}
            if self.spin_std.any()
            else None,
            "twins": {c: EFFECTS[c].twins for c in self.amounts if c in EFFECTS},
            "lookalikes": {c: [o for pair in LOOKALIKES if c in pair for o in pair if o != c] for c in self.amounts},
        }


def _generator(case: Case, use: str) -> np.random.Generator:
    """Random numbers for one use, the same in every process."""
    return np.random.default_rng([case.seed, zlib.crc32(use.encode())])


def build(case: Case) -> BallCase:
    """Draws the balls of a ball case and scales its causes, each alone, to the case's size."""
    own = draw_balls(_generator(case, "balls"), case.count)
    target = 1e-3 * case.size_mm
    few = own.take(np.sort(_generator(case, "few").permutation(len(own))[:SCALING_BALLS]))
    amounts = {}
    for cause in case.causes:
        signs = EFFECTS[cause].signs if cause in EFFECTS else (-1, 1)
        sign = float(_generator(case, f"sign {cause}").choice(signs))
        if case.kind == "bounce":
            amounts[cause] = sign * float(_generator(case, f"size {cause}").uniform(*BOUNCES[cause]))
        elif case.kind == "many":
            amounts[cause] = sign * EFFECTS[cause].amount * abs(_generator(case, f"size {cause}").standard_normal())
        else:
            amounts[cause] = sign * _scaled(case, cause, sign, few, target)
    world = World(magnus_coefficient=MAGNUS) if case.human else World()
    spinning = draw_human(_generator(case, "people"), case.count, world) if case.human else own
    mean, std = np.zeros(3), np.zeros(3)
    for cause, amount in amounts.items():
        world, spinning = _apply(case, cause, amount, world, spinning)
        if cause == "magnus":
            mean, std = (amount * s for s in _spin_shape(case))
    kalman = _kalman(case, few) if case.kind == "kalman" else None
    if kalman is not None:
        amounts["tracker_filter"] = kalman[0]
    return BallCase(case, world, spinning, amounts, mean, std, kalman and kalman[1:])


def _kalman(case: Case, balls: Balls) -> tuple[float, float, float]:
    """Largest error [m] of a tracker's filter that matters on these balls, its jerk and its gate."""
    rng = _generator(case, "filter")
    clean = measure(World(), balls, "iid", rng).clean
    while True:
        jerk, gate = float(np.exp(rng.uniform(np.log(10.0), np.log(200.0)))), float(rng.uniform(10.0, 80.0))
        size = lag(clean, jerk, gate)
        if size > LEAST_LAG:
            return size, jerk, gate


def _scaled(case: Case, cause: str, sign: float, balls: Balls, target: float) -> float:
    """Amount > 0 whose shift is ``target`` [m]: the shift is nearly proportional, so a few secant steps do.

    The shift is the median over balls; for what is not in a catalogue the root mean square, because a defect of one
    place or one hour leaves most balls alone.
    """
    amount = EFFECTS[cause].amount if cause in EFFECTS else abs(INVENTED[cause].amount)
    amount *= target / 0.010
    for _ in range(SCALING_ROUNDS):
        world, spinning = _apply(case, cause, sign * amount, World(), balls)
        distance = shift(world, spinning, _generator(case, "jitter"))
        size = float(np.sqrt(np.mean(distance**2)) if cause in INVENTED else np.median(distance))
        if size <= 0.0:
            raise ValueError(f"{cause} of {sign * amount:g} moves nothing")
        amount *= float(np.clip(target / size, 0.2, 5.0))
    return amount


def _apply(case: Case, cause: str, amount: float, world: World, balls: Balls) -> tuple[World, Balls]:
    if cause in INVENTED:
        return INVENTED[cause].apply(world, amount, balls, _generator(case, cause)), balls
    effect = EFFECTS[cause] if cause in EFFECTS else None
    if effect is None:
        raise ValueError(f"unknown cause {cause!r}; known are {', '.join((*EFFECTS, *INVENTED))}")
    if cause == "magnus":
        balls = with_spin(balls, draw_spins(case, balls, amount))
    return replace(world, **{effect.field: effect.rule(getattr(world, effect.field), amount)}), balls


def _spin_shape(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Mean and deviation of the spins, up to a factor: topspin on the average, all three axes from stroke to stroke."""
    rng = _generator(case, "spin shape")
    mean = np.array([rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 1.5), 0.0, 0.0])
    return mean, np.array([rng.uniform(0.6, 1.2), rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.8)])


def draw_spins(case: Case, balls: Balls, amount: float) -> np.ndarray:
    """Spins (3, B): topspin turns about +x for balls towards -y and about -x for returns."""
    mean, std = _spin_shape(case)
    # One draw per ball in the order of the balls, so that a subset of them does not change its spins' law.
    white = _generator(case, f"spins {len(balls)}").standard_normal((3, len(balls)))
    direction = np.where(balls.human, 1.0, -1.0)
    return amount * (mean[:, None] * direction + std[:, None] * white)


@dataclass(frozen=True)
class RobotCase:
    """A drawn robot case: the joints' true responses."""

    case: Case
    joints: dict[str, robot.Joint]
    amounts: dict[str, float]

    def rows(self):
        rng = _generator(self.case, "robot")
        return robot.logs(self.joints, rng, gentle=self.case.kind == "unexcited" and self._needs_gentle())

    def _needs_gentle(self) -> bool:
        # A limit of speed above every command is not excited by any stroke; the rest needs strokes that hide it.
        return not self.case.causes[0].endswith("velocity_limit")

    def truth(self) -> dict:
        values = {c: getattr(self.joints[c.split(".")[0]], c.split(".")[1]) for c in self.amounts}
        twins = {c: _delay_twin(c) for c in self.amounts}
        # A delay may be reported on either side: the sum is what shows.
        for cause, names in twins.items():
            for name in names:
                joint, effect = name.split(".")
                values[name] = getattr(robot.nominal(joint), effect) + self.amounts[cause]
        return {
            "case": asdict(self.case),
            "amounts": self.amounts,
            "parameters": values,
            "spin": None,
            "twins": twins,
            "lookalikes": {},
        }


def _delay_twin(cause: str) -> tuple[str, ...]:
    joint, effect = cause.split(".")
    other = {"action_delay": "observation_delay", "observation_delay": "action_delay"}.get(effect)
    return (f"{joint}.{other}",) if other else ()


def build_robot(case: Case) -> RobotCase:
    joints = {name: robot.nominal(name) for name in robot.JOINTS}
    amounts = {}
    for cause in case.causes:
        name, effect = cause.split(".")
        rng = _generator(case, cause)
        peak = robot.PEAK[robot.JOINTS.index(name)]
        amount = float(rng.uniform(*ROBOT_EFFECTS[effect]))
        if effect in ("velocity_limit", "acceleration_limit", "coulomb_friction", "deadband"):
            amount *= peak
        if effect == "velocity_gain":
            amount *= float(rng.choice([-1, 1]))
        if case.kind == "unexcited":
            amount = 3.0 * peak if effect == "velocity_limit" else amount
        old = getattr(joints[name], effect)
        value = amount if not np.isfinite(old) else old + amount
        joints[name] = replace(joints[name], **{effect: value})
        amounts[cause] = value - old if np.isfinite(old) else value
    return RobotCase(case, joints, amounts)


SIZES = (5.0, 10.0, 20.0)
KINDS = (
    "none",
    "noise",
    "single",
    "pair",
    "triple",
    "gauge",
    "deleted",
    "invented",
    "many",
    "bounce",
    "robot",
    "unexcited",
    "robot_none",
    "kalman",
    "human_none",
    "human_single",
    "human_pair",
    "human_deleted",
    "human_invented",
)
# Restitution from 0.75 to 0.91 and friction from 0.08 to 0.42 beside 0.93 and 0.25: far from a straight line.
BOUNCES = {"table_restitution": (0.02, 0.18), "table_friction": (0.03, 0.17)}
BOUNCE_BALLS = 60
# Of which a log with many causes has 2 to 8.
MANY = (
    "drag_coefficient",
    "wind_x",
    "wind_y",
    "wind_z",
    "gravity_scale",
    "table_restitution",
    "table_restitution_speed",
    "table_friction",
    "table_height",
    "table_tilt_x",
    "table_tilt_y",
    "camera_scale",
    "camera_rotation_x",
    "camera_rotation_y",
    "camera_distortion",
    "tracker_smoothing",
)


def draw(kind: str, count: int, seed: int, size_mm: float | None = None) -> list[Case]:
    """``count`` cases of one kind, causes taken in turn so that each appears about equally often."""
    if kind not in KINDS:
        raise ValueError(f"unknown kind {kind!r}; known are {', '.join(KINDS)}")
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode()), int(10 * (size_mm or 0))])
    noises = WRONG_NOISES if kind == "noise" else NOISES
    human, kind = kind, kind.removeprefix("human_")
    human = human if human != kind else ""
    # Where every ball spins spin is no cause.
    singles, names = [name for name in EFFECTS if not (human and name == "magnus")], []
    # The spin that the bounce itself gives a ball makes k 0.6 a shift of 7 mm.
    too_large = ("magnus",) if size_mm is not None and size_mm < 8.0 else ()
    while len(names) < count:
        names += _round(kind, rng, singles, too_large)
    cases = []
    for i, causes in enumerate(names[:count]):
        size = size_mm or float(rng.choice(SIZES if kind == "single" else SIZES[1:]))
        if kind in ("none", "noise", "many", "bounce", "robot", "unexcited", "robot_none", "kalman"):
            size = 0.0
        without: tuple[str, ...] = ()
        if kind == "deleted":
            # Every other time the twins are gone as well, so that nothing true is left to name.
            effect = EFFECTS[causes[0]]
            radius = ("ball_radius",) if causes[0] in _DRAG else ()
            without = causes if i % 2 else (*causes, *effect.twins, *radius)
        noise, seed_ = str(noises[i % len(noises)]), int(rng.integers(2**31))
        balls = BOUNCE_BALLS if kind == "bounce" else None
        cases.append(Case(human or kind, tuple(causes), size, noise, seed_, without, balls))
    return cases


def _round(
    kind: str, rng: np.random.Generator, singles: list[str], too_large: tuple[str, ...]
) -> list[tuple[str, ...]]:
    """One round of causes of a kind, shuffled."""
    if kind in ("none", "noise", "robot_none", "kalman"):
        return [()]
    if kind == "bounce":
        return [tuple(BOUNCES)]
    if kind in ("single", "deleted"):
        pool = [(name,) for name in singles if name not in too_large]
    elif kind == "gauge":
        pool = [(name,) for name in (*_DRAG, *_GRAVITY, *_TILT_X, *_TILT_Y)]
    elif kind == "invented":
        pool = [(name,) for name in INVENTED]
    elif kind == "many":
        return [tuple(rng.choice(MANY, rng.integers(2, 9), replace=False).tolist()) for _ in range(10)]
    elif kind in ("pair", "triple"):
        return [_together(2 if kind == "pair" else 3, rng, singles) for _ in range(10)]
    else:
        effects = list(ROBOT_EFFECTS)
        if kind == "unexcited":
            effects = ["velocity_limit", "acceleration_limit", "backlash"]
        order = rng.permutation(8)
        pool = [(f"{robot.JOINTS[order[i % 8]]}.{effect}",) for i, effect in enumerate(effects)]
    return [pool[i] for i in rng.permutation(len(pool))]


def _together(count: int, rng: np.random.Generator, singles: list[str]) -> tuple[str, ...]:
    """Causes of different families."""
    while True:
        chosen = tuple(singles[i] for i in rng.choice(len(singles), count, replace=False))
        if all(sum(c in family for c in chosen) < 2 for family in FAMILIES):
            return chosen
