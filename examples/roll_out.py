"""Play 1,000 balls of a person with a trained policy and draw where they land: python examples/roll_out.py ARTEFACT"""

import sys

import matplotlib.pyplot as plt

import mjx_tt

mjx_tt.configure()  # before JAX starts
policy = mjx_tt.load_policy(sys.argv[1] if len(sys.argv) > 1 else "runs/quickstart/artefact")
play = mjx_tt.make_rollout(balls="player3/M0", model=sys.argv[2] if len(sys.argv) > 2 else None)
played = play(policy, episodes=1000, seed=0)

print(f"returned {(played.outcome == 'returned').mean():.1%}, mean reward {played.returns[played.finite].mean():.2f}")
for name, term in played.terms.items():
    print(f"  {name:20} {term.mean():+.3f}")
plt.scatter(*played.landing[played.outcome == "returned"].T, s=4)
plt.xlabel("x [m]")
plt.ylabel("y [m]")
plt.savefig("landing.png")
