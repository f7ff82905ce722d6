"""A user's reward terms against the package's own, the paper's network as a user would write it, and mistakes."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from mjx_tt.env import make, user_defined
from mjx_tt.env.policy import Policy, initial_theta
from mjx_tt.env.reward_weights import SIM_WEIGHTS, TERMS
from mjx_tt.env.task import APPROACH_RANGE, TaskConfig, weigh_rewards

MINE = """
import jax.numpy as jnp
from mjx_tt import reward_term
from robot_io.limits import LIMITS

@reward_term("slow")
def slow(step):  # the package's term "velocity", written by hand
    limit = jnp.array(LIMITS.velocity).reshape((8,) + (1,) * (step.command.ndim - 1))
    return 1.0 - jnp.minimum(jnp.abs(step.command) / limit, 1.0).mean(axis=0)

@reward_term("clear_of_the_table", reduce="minus_sum")
def clear(step):
    return (step.table_gap <= 0.0) | (step.own_gap <= 0.0)

@reward_term("near", per="ball")
def near(ball):
    return ball.closest

@reward_term("seconds", per="ball")
def seconds(ball):
    return ball.steps / 75.0

@reward_term("always", per="ball")
def always(ball):
    return 2.0
"""


def played(config: TaskConfig, policy: Policy) -> make.PlayedEpisodes:
    return make.make_rollout("narrow", task=config, devices=1)(policy, 200, seed=5)


@pytest.fixture(scope="module")
def policy():
    theta = np.asarray(initial_theta(jax.random.key(3), 1.0))
    rng = np.random.default_rng(0)
    return Policy(theta, rng.normal(0, 0.1, 11).astype(np.float32), rng.uniform(0.5, 2, 11).astype(np.float32))


def test_a_users_terms_are_the_packages_written_by_hand(policy):
    terms = user_defined.load(MINE, "terms.py").rewards.values()
    weights = SIM_WEIGHTS | {"slow": 0.5, "near": 2.0, "always": 1.0}
    found = played(TaskConfig(sim_rate=75.0, rewards=weigh_rewards(weights, terms)), policy)
    assert tuple(found.terms) == (*TERMS, "slow", "clear_of_the_table", "near", "seconds", "always")
    np.testing.assert_allclose(found.terms["slow"], found.terms["velocity"], atol=1e-5)
    assert (found.terms["collision"] < 0).any()  # the untrained robot hits something
    np.testing.assert_array_equal(found.terms["clear_of_the_table"], found.terms["collision"])
    np.testing.assert_allclose(found.terms["seconds"], found.seconds, rtol=1e-6)
    missed = found.outcome == "missed"
    approached = 3.0 * np.exp(-found.terms["near"] / APPROACH_RANGE)
    np.testing.assert_allclose(approached[missed], found.terms["state_transition"][missed], rtol=1e-4)
    np.testing.assert_array_equal(found.terms["always"], 2.0)
    total = sum(weight * found.terms[name] for name, weight in weights.items())
    np.testing.assert_allclose(found.returns, total, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_a_term_that_is_no_number_is_masked_and_counted(policy):
    text = GOOD + '\n@reward_term("bad", per="ball")\ndef bad(ball):\n    return jnp.where(ball.hit, 0.0, jnp.nan)\n'
    terms = user_defined.load(text, "bad.py").rewards.values()
    found = played(TaskConfig(sim_rate=75.0, rewards=weigh_rewards(SIM_WEIGHTS | {"bad": 1.0}, terms)), policy)
    plain = played(TaskConfig(sim_rate=75.0), policy)
    np.testing.assert_array_equal(found.finite, plain.outcome != "missed")
    assert np.isnan(found.returns[~found.finite]).all()


GOOD = "import jax.numpy as jnp\nfrom mjx_tt import network, observation_term, reward_term\n"


def reward(body: str = "return 0.0", name: str = "'x'") -> str:
    return f"@reward_term({name})\ndef f(step):\n    {body}\n"


def observation(body: str, name: str = "x") -> str:
    return f"@observation_term({name!r})\ndef f(sensed):\n    return {body}\n"


def a_network(shape: tuple[int, int], step: str) -> str:
    functions = f"    start = staticmethod(lambda p, x: ())\n    step = staticmethod(lambda p, s, x: {step})\n"
    return f"@network('n', shapes={{'w': {shape}}})\nclass N:\n{functions}"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("import nothing_of_that_name\n", r"line 3: ModuleNotFoundError: No module named 'nothing_of"),
        ("def f(:\n", r"line 3: invalid syntax"),
        ("", "defines nothing"),
        (reward(name="'style'"), "'style': the name is one of the package's own"),
        (reward(name="'a b'"), "must be letters, digits"),
        (reward(name="'x', per='day'"), "(per is 'day', allowed: step, ball|TypeCheckError)"),
        (reward(name="'x', reduce='max'"), "'max', allowed: mean, one_minus"),
        (reward() + reward().replace("def f", "def g"), "'x': defined twice"),
        (reward("return step.comand"), "line 5: AttributeError: .*comand"),
        (reward("return step.command"), r"returns an array \(8, 2, 3\)"),
        (reward("return 1 if step.bounced else 0"), "line 5: The truth value"),
        (observation("sensed.bal"), "line 5: AttributeError: .*bal"),
        (observation("sensed.ball[0]"), "rows of numbers"),
        (observation("sensed.ball", "ball_x"), "the package's own"),
        ("@network('n', shapes={'w': (8, 11)})\nclass N:\n    pass\n", "has no start and no step"),
        (a_network((7, 11), "(p['w'] @ x, s)"), r"returns an action \(7,\), \(8,\) is wanted"),
        (a_network((8, 11), "(p['w'] @ x, x)"), "another kind of state"),
        (a_network((8, 0), "(x, s)"), "positive whole numbers"),
    ],
)
def test_a_mistake_in_the_file_is_named(text, says):
    with pytest.raises(ValueError, match=f"(?s)my.py.*{says}"):
        user_defined.load(GOOD + text, "my.py").checked_network("n", 11)
