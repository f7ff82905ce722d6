"""Delays of a robot that was identified: one of the five shows nowhere, and the others are against it.

Ball, arm and axes meet at one time, so that a later clock of all three changes nothing that a policy or a log sees:
measurements come sooner, commands take effect later. The arm's measurement is taken to be as late as believed, which
fixes that clock. A log of the joints shows the sum of the delays of command and measurement of each bus, and hits show
how late ball and axes are measured against the arm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from mjx_tt.diagnosis.together import hits
from mjx_tt.sim.randomisation import Samples

ARM, AXES, BALL = "latency.abb_observation", hits.AXES, hits.BALL
AXES_COMMAND = "latency.festo_action"  # the axes' command
SEED = 2  # of the draws; those of balls, joints and hits have others

Ends = Mapping[str, tuple[float, float]]  # low and high end by dotted path


def shift_to_arm(ranges: Ends, believed: float) -> dict[str, tuple[float, float]]:
    """The prior's ranges with those of ball and axes as late against the arm as the arm's own range lets them be.

    believed: [s] of the arm's measurement.
    """
    out = dict(ranges)
    if ARM in ranges:
        sooner, later = ranges[ARM]
        for path in (AXES, BALL):
            if path in ranges:
                low, high = ranges[path]
                out[path] = (max(low + believed - later, 0.0), high + believed - sooner)
    return out


def compute_moments(ranges: Ends, believed: float) -> dict[str, tuple[float, float]]:
    """Mean and standard deviation of each parameter, uniform in its range; of ball and axes against the arm."""
    out = {path: (0.5 * (low + high), (high - low) / 12**0.5) for path, (low, high) in ranges.items()}
    if ARM in ranges:
        mean, deviation = out[ARM]
        for path in (AXES, BALL):
            if path in ranges:
                out[path] = (out[path][0] + believed - mean, float(np.hypot(out[path][1], deviation)))
    return out


def draw_unseen(ranges: Ends, believed: float, paths: Sequence[str], count: int) -> Samples:
    """Delays of measurements that no log shows, each against the arm's: (count, len(paths)) draws of the prior."""
    rng = np.random.default_rng(SEED)
    arm = rng.uniform(*ranges[ARM], count) if ARM in ranges else np.full(count, believed)
    columns = [np.maximum(rng.uniform(*ranges[path], count) + believed - arm, 0.0) for path in paths]
    return Samples(tuple(paths), np.stack(columns, axis=1), np.ones(count))


def shift_command(samples: Samples, believed: float) -> Samples:
    """The same with the axes' command sooner by what their measurement is later than believed, row by row.

    The log of the joints shows the sum of the two; believed: [s] of the measurement, with which the command was found.
    """
    return _change_command(samples, lambda command, seen: np.maximum(command - (seen - believed), 0.0))


def restore_command(samples: Samples, believed: float) -> Samples:
    """The same with the axes' command as ``shift_command`` had it: with the measurement at ``believed``."""
    return _change_command(samples, lambda command, seen: command + (seen - believed))


def _change_command(samples: Samples, change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Samples:
    if not {AXES_COMMAND, AXES} <= set(samples.paths):
        return samples
    values = samples.values.copy()
    command, seen = (samples.paths.index(path) for path in (AXES_COMMAND, AXES))
    values[:, command] = change(values[:, command], values[:, seen])
    return replace(samples, values=values)


def add_to_sums(truth: Mapping[str, float], world: Mapping[str, float]) -> dict[str, float]:
    """A reality's values, by dotted path, with its delays as logs and play can show them.

    world: values of the world that they stand beside: where the arm's measurement fixes the clock, and where the axes'
    stands in their command's (``restore_command``).
    """
    found = dict(truth)
    later = world[ARM] - truth[ARM]
    for path in (BALL, AXES):
        found[path] += later
    found["latency.abb_action"] -= later
    found[AXES_COMMAND] += truth[AXES] - world[AXES]
    return found | {ARM: world[ARM]}
