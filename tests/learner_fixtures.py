"""Learners of tiny networks and rings of random transitions, for several files of tests."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.common import replay
from cmrl_jax.config.schema import Config
from cmrl_jax.jax_runtime import jit_once

TASKS, BATCH, CONTEXT, OBS, ACT, GOAL, LATENT = 3, 4, 5, 3, 2, 6, 2
LANES, CAPACITY = 2, 24
GOALS = jnp.asarray(np.random.default_rng(3).normal(size=(TASKS, 4, GOAL)), jnp.float32)


def tiny_config(**sections):
    """Default options at tiny sizes; `sections` override fields, as model={"net": "mlp"}."""
    sizes = {
        "model": {"mlp_hidden": (8,), "modules": (2, 2, 4), "trunk_width": 8, "gating_width": 4,
                  "router_input": "z*obs",
                  "critic_bins": 5, "critic_v_max": 2.0},
        "encoder": {"hidden": (8,), "latent_dim": LATENT, "goal_width": 3, "context_max": CONTEXT,
                    "aux": "none", "p_empty": 0.15, "p_drop_goal": 0.2},
        "kl": {"beta": 0.1},
        "sac": {"batch": BATCH, "normalize_obs": False, "reward_norm": "none"},
        "collect": {"lanes": TASKS * LANES},
    }  # fmt: skip
    cfg = Config()
    for name, values in sizes.items():
        section = replace(getattr(cfg, name), **(values | sections.get(name, {})))
        cfg = replace(cfg, **{name: section})
    return cfg


PEARL = {
    "model": {"net": "mlp", "norm": "none", "init": "official"},
    "encoder": {"goal_fusion": "none", "poe": "pearl", "context_len": "fixed", "p_empty": 0.0},
    "sac": {"variant": "v", "alpha": "fixed", "alpha_init": 1.0, "policy_reg": 1e-3,
            "grad_clip": 0.0, "task_rows": 5, "reward_scale": 5.0},
    "kl": {"reduce": "sum_tasks"},
}  # fmt: skip
VARIANTS = {
    "cmrl": {},
    "c51": {
        "model": {"net": "mlp", "critic": "c51"},
        "sac": {"alpha": "shared", "loss_balance": "sac_temp"},
    },
    "pearl": PEARL,
    "cmrl-paper": {
        "model": {"router_input": "z", "trunk_input": "obs_z", "modules": (3, 3, 4)},
        "encoder": {"goal_fusion": "concat", "p_empty": 0.0},
        "sac": {"variant": "v", "alpha": "fixed", "task_reduce": "sum"},
        "collect": {"context_source": "all"},
    },
    "recon": {"encoder": {"aux": "recon"}},
    "contrastive": {"encoder": {"aux": "contrastive"}},
    "mtsac": {"model": {"net": "mlp", "conditioning": "task_id"}},
    "sac": {"model": {"net": "mlp", "conditioning": "none"}},
}


def filled_ring(seed=0, reward=None, terminated=False, capacity=CAPACITY):
    """A full ring of random transitions, two lanes a task, an episode border every 4 steps."""
    rng = np.random.default_rng(seed)
    steps = capacity // LANES
    lead = (steps, TASKS, LANES)
    time = np.broadcast_to(np.arange(steps)[:, None, None], lead)
    rewards = rng.normal(size=lead) if reward is None else np.broadcast_to(reward, lead)
    transitions = replay.Transition(
        obs=jnp.asarray(rng.normal(size=(*lead, OBS)), jnp.float32),
        action=jnp.asarray(np.tanh(rng.normal(size=(*lead, ACT))), jnp.float32),
        reward=jnp.asarray(rewards, jnp.float32),
        terminated=jnp.full(lead, terminated),
        truncated=jnp.asarray(time % 4 == 3),
        first=jnp.asarray(time % 4 == 0),
        next_obs=jnp.asarray(rng.normal(size=(*lead, OBS)), jnp.float32),
    )
    return replay.add(replay.init_replay(TASKS, capacity, LANES, OBS, ACT), transitions)


def build(cfg):
    learner = Learner(cfg, GOALS, OBS, ACT)
    return SimpleNamespace(
        learner=learner,
        state=jit_once(learner.init)(jax.random.key(0)),
        update=jax.jit(learner.update),
    )


def spread(params, seed=1):
    rng = np.random.default_rng(seed)
    return jax.tree.map(
        lambda x: jnp.asarray(rng.normal(scale=0.5, size=x.shape), jnp.float32), params
    )
