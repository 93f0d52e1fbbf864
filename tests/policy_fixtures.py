"""A small session on native physics, and policies whose every weight matters, for evaluation tests.

An untrained policy hardly reacts to its latent (its heads start near 0), so weights are drawn at
random here: what a test changes then shows in every score.
"""

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.algorithms.cmrl.agent import PolicyParams
from cmrl_jax.config.files import load_config, to_yaml
from cmrl_jax.evaluation.session import Session
from cmrl_jax.nn.normalizers import init_obs_stats
from cmrl_jax.storage.checkpoint import policy_store
from cmrl_jax.storage.versions import package_versions
from envs.sawyer import Ml4Env

HORIZON = 6


def small_config(**flags):
    """smoke.yaml on native physics with episodes of `HORIZON` steps, in two chunks.

    With observations as `MovingEnv` has them, and a routing that looks at them.
    """
    sizes = {"env.horizon": str(HORIZON), "collect.chunk": str(HORIZON // 2)}
    parts = {"env.obs_mode": "metaworld", "model.router_input": "z*obs", "encoder.aux": "none"}
    return load_config("smoke.yaml", {"env.physics": "native", **parts, **sizes, **flags})


class MovingEnv(Ml4Env):
    """The native environment with the hand's movement as reward, and successes that come and go.

    Meta-World's rewards hardly differ between two policies in the first steps of an episode; the
    way the hand goes does. Success comes every second step of the first task, every third of the
    second, ...
    """

    def __init__(self):
        super().__init__(physics="native")

    def step(self, state, action):
        new = super().step(state, action)
        moved = new.obs[:3] - new.obs[18:21]  # metres, this frame less the last
        reward = 300 * moved @ jnp.array([1.0, 2.0, 3.0])
        is_success = new.steps % (state.task_id + 2) == 0
        return new.replace(reward=reward, success=is_success, distance=new.obs[0])


def random_policy(session: Session, seed: int):
    """PolicyParams with every weight drawn from a normal of std 0.5."""
    params = jax.eval_shape(session.algorithm.parts.init, jax.random.key(0))
    generator = np.random.default_rng(seed)
    draw = lambda x: generator.normal(0, 0.5, x.shape).astype(np.float32)
    inference, tasks = session.algorithm.parts.inference, session.algorithm.parts.num_tasks
    return PolicyParams(
        actor_params=jax.tree.map(draw, params.actor_params),
        encoder_params=jax.tree.map(draw, params.encoder_params),
        obs_stats=init_obs_stats(params.obs_stats.mean.size),
        task_z=None if inference is None else draw(np.empty((tasks, inference.latent_dim))),
    )


def save_run(run, session: Session, seeds, goals_sha256=None):
    """A run directory with the policy checkpoints 1, 2, ... of random policies."""
    run.mkdir(parents=True)
    (run / "config.yaml").write_text(to_yaml(session.config))
    with policy_store(run) as store:
        for iteration, seed in enumerate(seeds, 1):
            policy = {
                "params": random_policy(session, seed),
                "goal_vectors": session.goals.vectors[:, 0],
            }
            meta = {
                "config": {},
                "iteration": iteration,
                "env_steps": 100 * iteration,
                "wall_s": 0.0,
                "csv_offset": 0,
                "versions": package_versions(),
                "goals_sha256": goals_sha256 or session.goals.sha256,
            }
            store.save({"policy": policy}, meta)
    return run
