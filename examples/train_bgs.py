"""Train a policy by Blackbox Gradient Sensing, an ask and a tell each update: python examples/train_bgs.py [UPDATES]"""

import sys

import jax

import ballmodel
import bgs
import mjx_tt

mjx_tt.configure()
key, simulator = jax.random.key(0), mjx_tt.Simulator(mjx_tt.TaskConfig(sim_rate=150.0))
balls = ballmodel.sample_pool(key, ballmodel.resolve("player3/M0"), mjx_tt.SimModel().ball, 4096)
config = bgs.BGSConfig(num_directions=50, elite_fraction=1.0, step=bgs.optimizers.make("adam", 0.01))
state = bgs.init(mjx_tt.initial_theta(key), config)
mean, inv_std = jax.numpy.zeros(11), jax.numpy.ones(11)  # bgs.normalizer learns them
draw = jax.jit(lambda key: simulator.draw(key, balls, mjx_tt.SimModel(), (), 5, 100))
play = jax.jit(lambda members, episodes: simulator.rollout(mjx_tt.Policy(members, mean, inv_std), episodes))
for update in range(int(sys.argv[1]) if len(sys.argv) > 1 else 300):
    population = bgs.ask(jax.random.fold_in(key, update), state, config)
    played = play(population.members, draw(jax.random.fold_in(key, 10_000 + update)))
    state, info = bgs.tell(state, population, played.returns.mean(axis=0), config)
    print(update, f"mean return {info.mean_return:.3f}, hit {(played.outcome > 0).mean():.1%}")
mjx_tt.Policy(state.theta, mean, inv_std).save("policy.npz")
