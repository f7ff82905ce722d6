"""Sides of the comparisons. Each function prepares one and returns (what it says about itself, its work).

The work is a function without arguments that returns how much it did: physics steps or episodes.

All robot-only sides do the same: the robot of the MJCF from its home pose, 300 physics steps per second, new random
velocity commands 75 times per second.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from mjx_tt.env.policy import Policy

if TYPE_CHECKING:  # a side without JAX does not load it
    from jax import Array

    from experiments.training.update import Trainer, TrainState
    from mjx_tt.env.episode import Episodes
    from mjx_tt.env.rollout import RolloutResult

    State: TypeAlias = tuple[Array, Array]  # qpos, qvel

Side = tuple[dict, Callable[[], float]]

SIM_RATE = 300.0
SUBSTEPS = 4  # physics steps per command
COMMAND = 0.2  # largest command, as a share of each joint's speed limit: no joint leaves its range within a run


def fused(lanes: int, chunks: int, steps: int) -> Side:
    """The fused engine lane by lane in float32: on every device ``chunks`` batches of ``lanes`` robots in turn."""
    return _jax_engine("fused", lanes, chunks, steps)


def fused_by_xla(lanes: int, chunks: int, steps: int) -> Side:
    """The same compiled by XLA."""
    return _jax_engine("fused", lanes, chunks, steps, by_lanes=False)


def mjx(lanes: int, chunks: int, steps: int) -> Side:
    """MuJoCo MJX in float32, likewise."""
    return _jax_engine("mjx", lanes, chunks, steps, by_lanes=False)


def _jax_engine(name: str, lanes: int, chunks: int, steps: int, by_lanes: bool = True) -> Side:
    from mjx_tt import platform

    platform.configure()
    import jax
    import jax.numpy as jnp
    from jax.sharding import Mesh, PartitionSpec

    from mjx_tt.env.task import Task, TaskConfig
    from mjx_tt.lanes.loop import while_any
    from mjx_tt.robot.scalar_algebra import optimization_barrier

    task = Task(TaskConfig(engine=name, sim_rate=SIM_RATE))
    devices = jax.devices()
    home = jnp.broadcast_to(jnp.asarray(task.home, jnp.float32)[:, None], (8, lanes))

    def period(tick: Array, state: tuple[Array, State], controls: Array, _: tuple) -> tuple[Array, State]:
        def step(_: int, s: State) -> State:
            return optimization_barrier(task.engine.step(*s, control))

        control = jax.lax.dynamic_index_in_dim(controls, tick, keepdims=False)
        return state[0], jax.lax.fori_loop(0, SUBSTEPS, step, state[1])

    def chunk(controls: Array) -> State:  # (steps / SUBSTEPS, 8, lanes)
        start = (jnp.ones(lanes, bool), (home, jnp.zeros_like(home)))
        return while_any(lambda s: s[0], period, start, controls, limit=steps // SUBSTEPS, lanes=by_lanes)[1]

    def device(controls: Array) -> State:  # (chunks, steps / SUBSTEPS, 8, lanes)
        return jax.lax.map(chunk, controls)

    mesh = Mesh(np.array(devices), ("device",))
    split = PartitionSpec("device")
    run = jax.jit(jax.shard_map(device, mesh=mesh, in_specs=split, out_specs=split, check_vma=False))
    controls = commands((len(devices) * chunks, steps // SUBSTEPS, 8, lanes), axis=2)
    controls = jax.device_put(controls, jax.sharding.NamedSharding(mesh, split))

    def work() -> float:
        jax.block_until_ready(run(controls))
        return len(devices) * chunks * lanes * steps

    return about_jax(), work


def mujoco_rollout(robots: int, steps: int, threads: int) -> Side:
    """MuJoCo C's own batch roll-out in float64 with a pool of threads that stays alive."""
    import mujoco
    from mujoco import rollout

    from mjx_tt.robot import mjcf

    model = mjcf.load_model()
    model.opt.timestep = 1.0 / SIM_RATE
    data = [mujoco.MjData(model) for _ in range(threads)]
    mujoco.mj_resetDataKeyframe(model, data[0], 0)
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    first = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data[0], first, kind)
    start = np.tile(first, (robots, 1))
    controls = np.repeat(commands((robots, steps // SUBSTEPS, 8), axis=2).astype(float), SUBSTEPS, axis=1)
    states = np.empty((robots, steps, len(first)))
    sensors = np.empty((robots, steps, model.nsensordata))
    pool = rollout.Rollout(nthread=threads)

    def work() -> float:
        pool.rollout(model, data, start, controls, nstep=steps, state=states, sensordata=sensors)
        return robots * steps

    return {"version": mujoco.__version__}, work


def update(changes: list[str], devices: int | None = None, name: str = "paper") -> Side:
    """One training update of a shipped experiment, the paper's settings if none is named, with some keys changed."""
    from mjx_tt import platform

    platform.configure(devices)
    import jax

    trainer, state = _trainer(changes, name)
    compiled = trainer.lower(state).compile()

    def work() -> float:
        nonlocal state
        state, _ = jax.block_until_ready(compiled(state, trainer.inputs))
        return trainer.episodes_per_update

    return about_jax(), work


def rollout(changes: list[str], devices: int | None = None) -> Side:
    """The roll-outs of such an update alone, on episodes already drawn."""
    import jax

    compiled, arguments, episodes = _rollout(changes, devices)

    def work() -> float:
        jax.block_until_ready(compiled(*arguments))
        return episodes

    return about_jax(), work


def played(changes: list[str]) -> RolloutResult:
    """The results of these roll-outs."""
    compiled, arguments, _ = _rollout(changes, None)
    return compiled(*arguments)


def _rollout(changes: list[str], devices: int | None) -> tuple[Callable, tuple, int]:
    from mjx_tt import platform

    platform.configure(devices)
    import jax
    import jax.numpy as jnp

    from mjx_tt.env.rollout import RESULT_SPECS
    from mjx_tt.sim.model import SimModel

    trainer, state = _trainer(changes)
    simulator, columns = trainer.simulator, 2 * trainer.bgs_config.num_directions
    repeats = trainer.episodes_per_update // columns
    episodes = simulator.draw(jax.random.key(2), trainer.pool, SimModel(), (), repeats, columns)
    theta = state.bgs.theta[:, None] + 0.025 * jax.random.normal(jax.random.key(3), (state.bgs.theta.shape[0], columns))

    def play(theta: Array, episodes: Episodes) -> RolloutResult:
        policy = Policy(simulator.local(theta), jnp.zeros(11), jnp.ones(11))
        return simulator.rollout(policy, simulator.local(episodes))

    arguments = simulator.replicate((theta, episodes))
    compiled = jax.jit(simulator.on_devices(play, out_specs=RESULT_SPECS)).lower(*arguments).compile()
    return compiled, arguments, trainer.episodes_per_update


def _trainer(changes: list[str], name: str = "paper") -> tuple[Trainer, TrainState]:
    import jax

    from experiments.config import build, experiment, files
    from experiments.training.loop import make_trainer

    config = experiment.load(files.find_shipped(name, "train"), tuple(changes))
    trainer = make_trainer(build.experiment(config, name))
    return trainer, trainer.init(jax.random.key(0))


def about_jax() -> dict:
    import jax

    devices = jax.devices()
    return {"device": f"{len(devices)} x {devices[0].device_kind} ({devices[0].platform})", "version": jax.__version__}


def commands(shape: tuple[int, ...], axis: int) -> np.ndarray:
    """Random joint velocities [m/s], [rad/s], float32, of this shape; ``axis`` counts the joints."""
    from robot_io.limits import LIMITS

    largest = COMMAND * np.asarray(LIMITS.velocity, np.float32).reshape((-1,) + (1,) * (len(shape) - axis - 1))
    return np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32) * largest
