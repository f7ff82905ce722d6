"""Posterior of all drives from the joints' log: lags, gains, and a delay that the joints of one bus share.

Of the delays of command and measurement only the sum shows; the measurement's is left as the model has it and the
command's takes the change. In play sums alone matter as well. A lag and a delay look alike in slow motion: that all
joints of a bus have one delay is what tells them apart best. By Gauss-Newton with priors, a free offset in each window
of time; errors by the sandwich over these windows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mjx_tt.diagnosis.joint.coupling import coupling
from mjx_tt.diagnosis.joint.fit import residual, scale, slopes, weights
from mjx_tt.diagnosis.joint.forward_model import JointResponse, Motion, nominal_response
from mjx_tt.diagnosis.joint.log import JointLog, JointRecord
from mjx_tt.sim.model import SimModel
from mjx_tt.sim.randomisation import Samples
from robot_io.contract import FESTO_JOINTS, JOINT_NAMES

DRAWS = 256
FITTED = ("lag", "velocity_gain", "action_delay")
DELAY_DEVIATION = 0.025  # [s] of what is known beforehand of the sum of two delays of a bus
ROUNDS, PASSES = 6, 2  # of Gauss-Newton; with the other joints' motion as believed, then as found
SETTLED = 0.02  # deviations
LEAST_ERROR = 0.0003  # [s] of lags and delays, and of gains: a simulation moves by steps of 3 ms
Prior = Mapping[str, tuple[float, float]]  # mean and standard deviation by dotted path


@dataclass(frozen=True)
class JointsTogether:
    """Gaussian posterior of parameters by dotted path."""

    paths: tuple[str, ...]
    mean: Float[np.ndarray, " P"]
    covariance: Float[np.ndarray, "P P"]
    left: dict[str, float]  # [rad], [m] deviation of each joint's positions that nothing explains

    def samples(self, seed: int = 0) -> Samples:
        """Draws; delays and lags are not negative."""
        drawn = np.random.default_rng(seed).multivariate_normal(self.mean, self.covariance, DRAWS, method="eigh")
        return Samples(self.paths, np.maximum(drawn, 0.0), np.ones(DRAWS))


def fit(records: Sequence[JointRecord], model: SimModel, prior: Prior) -> JointsTogether:
    """The posterior of the paper's robot. prior: of ``drives.*.lag`` and ``drives.*.velocity_gain``.

    Raises ValueError where a joint has no record.
    """
    by_name = {record.joint: record for record in records}
    missing = [name for name in JOINT_NAMES if name not in by_name]
    if missing:
        raise ValueError(f"no record of {', '.join(missing)}; all joints are needed")
    nominal = {name: nominal_response(model, name, by_name[name].robot) for name in JOINT_NAMES}
    responses = dict(nominal)
    parts: list[JointsTogether] = []
    for _ in range(PASSES):
        beside = coupling(records, responses)
        buses = [[n for i, n in enumerate(JOINT_NAMES) if (i in FESTO_JOINTS) == festo] for festo in (True, False)]
        parts = [_bus(names, by_name, nominal, beside, prior) for names in buses]
        for part in parts:
            found = dict(zip(part.paths, part.mean, strict=True))
            action = next(value for path, value in found.items() if path.startswith("latency."))
            for name in part.left:
                values = {effect: float(found[f"drives.{name}.{effect}"]) for effect in FITTED[:2]}
                responses[name] = replace(nominal[name], **values, action_delay=max(float(action), 0.0))
    first, second = parts
    size = len(first.mean)
    covariance = np.zeros((size + len(second.mean),) * 2)
    covariance[:size, :size], covariance[size:, size:] = first.covariance, second.covariance
    mean = np.concatenate([first.mean, second.mean])
    return JointsTogether(first.paths + second.paths, mean, covariance, first.left | second.left)


def _bus(
    names: Sequence[str],
    records: Mapping[str, JointRecord],
    nominal: Mapping[str, JointResponse],
    beside: Mapping[str, Motion],
    prior: Prior,
) -> JointsTogether:
    """The joints of one bus: each one's lag and gain, and one sum of delays."""
    logs = [JointLog(records[name], nominal[name], beside.get(name)) for name in names]
    observation, delay = nominal[names[0]].observation_delay, logs[0].base["action_delay"]
    paths = [f"drives.{name}.{effect}" for name in names for effect in FITTED[:2]]
    mean, deviation = np.array([*(prior[path] for path in paths), (delay, DELAY_DEVIATION)]).T
    values, precision = mean.copy(), np.diag(deviation**-2.0)
    spread, covariance, left = np.zeros_like(precision), np.diag(deviation**2), np.zeros(len(names))
    for _ in range(ROUNDS):
        gram, right, spread = precision.copy(), precision @ (mean - values), precision.copy()
        for k, log in enumerate(logs):
            mine = [2 * k, 2 * k + 1, len(values) - 1]
            at = dict(zip(FITTED, values[mine].tolist(), strict=True))
            sigma = scale(log.centred(log.measured - log.simulate(at)))
            rest = residual(log, at, sigma)
            sigma = left[k] = scale(rest)
            weight = weights(rest, sigma)
            columns = log.centred(slopes(log, at), weight)
            place = np.ix_(mine, mine)
            gram[place] += columns.T @ (columns * weight[:, None]) / sigma**2
            right[mine] += columns.T @ (weight * rest) / sigma**2
            scores = np.add.reduceat(columns * (weight * rest)[:, None], log.starts, axis=0) / sigma**2
            spread[place] += scores.T @ scores
        inverse = np.linalg.inv(gram)
        covariance = inverse @ spread @ inverse
        change = inverse @ right
        values = np.maximum(values + change, 0.0)
        if np.max(np.abs(change) / np.sqrt(np.diagonal(inverse))) < SETTLED:
            break
    covariance = covariance + LEAST_ERROR**2 * np.eye(len(values))
    bus = "festo" if JOINT_NAMES.index(names[0]) in FESTO_JOINTS else "abb"
    values[-1] -= observation
    return JointsTogether(
        (*paths, f"latency.{bus}_action"), values, covariance, dict(zip(names, left.tolist(), strict=True))
    )
