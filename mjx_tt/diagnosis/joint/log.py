"""One joint's log made ready for fits: commands, the states that a fit looks at in their windows, the nominal model."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from mjx_tt.diagnosis.joint.forward_model import JointResponse
from mjx_tt.diagnosis.joint.records import JointRecord
from robot_io.contract import JOINT_NAMES, JOINT_UNITS, LIMITS

WINDOW = 2.0  # [s] of a free offset and of one cluster of the errors, a tenth of a log of less than 20 s
SAMPLES = 4000  # states of a joint that a fit looks at, evenly spread over the log


class JointLog:
    """Commands, states (n,) and nominal response of one joint.

    base: the nominal parameters that a fit may change; the two delays are one sum, under action_delay.
    sizes: of the commands that are not zero; fastest: the largest of them, 0 for a joint at rest.
    rated_velocity, rated_acceleration: what the joint is built for.
    every: indices of the states after the first command; time and measured (n,) are SAMPLES of them at most.
    starts, window: first samples of the windows (k,) and each sample's window (n,).
    """

    def __init__(self, record: JointRecord, nominal: JointResponse):
        self.record, self.nominal = record, nominal
        self.base = {f.name: getattr(nominal, f.name) for f in dataclasses.fields(nominal)}
        self.base["action_delay"] += self.base.pop("observation_delay")
        del self.base["joint_offset"]
        u = record.command_velocity
        keep = np.concatenate([[True], u[1:] != u[:-1]])  # a repeated command changes nothing
        self.command_time, self.command_velocity = record.command_time[keep], u[keep]
        sizes = np.abs(u)
        self.sizes = sizes[sizes > 0.0]
        self.fastest = float(sizes.max())
        i = JOINT_NAMES.index(record.joint)
        self.unit = JOINT_UNITS[i]
        self.rated_velocity, self.rated_acceleration = LIMITS.velocity[i], LIMITS.acceleration[i]
        self.every = use = np.flatnonzero(record.state_time >= record.command_time[0])
        if use.size > SAMPLES:
            use = use[np.round(np.linspace(0, use.size - 1, SAMPLES)).astype(int)]
        self.time, self.measured = record.state_time[use], record.state_position[use]
        self.width = min(max((self.time[-1] - self.time[0]) / 10.0, 0.3), WINDOW)
        self.starts, self.window = self.windows(self.time)

    def windows(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First samples of the windows (k,) and each sample's window (n,)."""
        window = np.floor((time - time[0]) / self.width).astype(int)
        starts = np.flatnonzero(np.concatenate([[True], window[1:] != window[:-1]]))
        return starts, np.repeat(np.arange(starts.size), np.diff(np.append(starts, time.size)))

    def response(self, values: Mapping[str, float]) -> JointResponse:
        """The nominal response with the sum of the delays as action_delay and some parameters replaced."""
        return dataclasses.replace(self.nominal, **{**self.base, **values}, observation_delay=0.0, joint_offset=0.0)

    def simulate(self, values: Mapping[str, float], time: np.ndarray | None = None) -> np.ndarray:
        """Positions of a joint with these parameters, at ``time`` or at the samples."""
        time = self.time if time is None else time
        return self.response(values).simulate(self.command_time, self.command_velocity, time)

    def centred(self, x: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
        """x (n, ...) less its mean in each window."""
        if weight is None:
            count = np.diff(np.append(self.starts, self.time.size))
            mean = (np.add.reduceat(x, self.starts, axis=0).T / count).T
        else:
            total = np.add.reduceat((x.T * weight).T, self.starts, axis=0)
            mean = (total.T / np.add.reduceat(weight, self.starts)).T
        return x - mean[self.window]
