"""Run an exported policy with NumPy alone, one observation at a time: python examples/run_policy.py ARTEFACT"""

import sys

import numpy as np

import robot_io

artefact = robot_io.load_artefact(sys.argv[1] if len(sys.argv) > 1 else "runs/quickstart/artefact")
policy = artefact.streaming()
policy.reset()  # a new ball
observation = np.zeros(len(robot_io.OBSERVATION_NAMES))
for tick in range(75):  # one second at 75 Hz
    observation[1] = 1.5 - 0.08 * tick  # the ball comes along y [m]
    velocity = policy.step(observation) * robot_io.LIMITS.policy_velocity  # [m/s], [rad/s]
    print(tick, dict(zip(robot_io.JOINT_NAMES, velocity.round(3).tolist(), strict=True)))
assert "jax" not in sys.modules
