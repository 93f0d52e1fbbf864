"""What a policy does inside: how its actor routes on every task, and what z it infers there.

One short evaluation by the protocol (evaluator.py) on MuJoCo C: `K` episodes of experience, then
the reported one, whose posterior, z and routing are kept. The critics route too, but a policy
checkpoint does not hold them.
"""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.algorithms.cmrl.agent import PolicyParams, z_noise
from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.common.rollout import rollout
from cmrl_jax.analysis.inspection_file import Inspection, Latents, Usage, write_inspection
from cmrl_jax.config.files import run_config
from cmrl_jax.evaluation.episode import Lanes, agent_keys
from cmrl_jax.evaluation.evaluator import Evaluator, Trial
from cmrl_jax.evaluation.options import EvalOptions
from cmrl_jax.evaluation.session import Policy, Session, load_policy, prepare_jax
from cmrl_jax.evaluation.settings import result_fields
from cmrl_jax.evaluation.trials import evaluation_config, trial_of
from cmrl_jax.nn.distributions import Gaussian, kl_to_standard_normal
from cmrl_jax.nn.networks import Routing

K = 2  # episodes of own experience
GOALS, DRAWS = 10, 3  # of a task, so 30 adaptation runs


def inspect_run(run: Path) -> Path | None:
    """Inspects a run's newest policy checkpoint; returns the file written, `inspection.json`.

    None for a policy with neither CMRL's latent nor its modules, which has nothing to show.

    Raises:
        ConfigError: no such checkpoint, it does not fit this program, or the directory refuses
            the file.
    """
    own = run_config(run)
    has_modules = own.model.net == "soft" and own.model.modular_actor
    if own.algorithm != "cmrl" or not (own.model.conditioning == "z" or has_modules):
        return None
    config = evaluation_config(run, "native")
    prepare_jax(config)
    session = Session(config)
    return write_inspection(run, inspect_policy(run, session, load_policy(run, session)))


def inspect_policy(
    run: Path, session: Session, policy: Policy, goals: int = GOALS, draws: int = DRAWS
) -> Inspection:
    """Inspects a policy on the first `goals` held-out goals of every task, `draws` runs each."""
    config, tasks = session.config, session.eval_tasks
    learner: Learner = session.algorithm.parts
    inference = learner.inference
    k = 0 if inference is None else K
    options = EvalOptions(k=(k,), goals=goals, draws=draws, physics="native")
    trial = trial_of([policy], session, options, tasks)
    evaluator = Evaluator(config, session.env, session.agent, len(tasks) * goals * draws)
    lanes = evaluator.lanes_of(trial)
    if inference is None:
        latents = None
        zc = learner.task_conditioning(evaluator.told_of(trial).task_row[0])
    else:
        latents = infer(session, learner, policy.params, evaluator, trial, options.seed)
        zc = latents.z.reshape(-1, inference.latent_dim)
    routing = mean_routing(session, learner, policy.params, lanes, jnp.asarray(zc))
    facts = {"k": k} | result_fields(run, policy.meta, options, config)
    return Inspection(tasks, usage_of(routing, len(tasks)), latents, facts)


def infer(
    session: Session,
    learner: Learner,
    params: PolicyParams,
    evaluator: Evaluator,
    trial: Trial,
    seed: int,
) -> Latents:
    """Posteriors of all lanes before any episode and after `K`, and the z's of the one after."""
    inference = learner.inference
    assert inference is not None  # the caller has looked
    memories = [e.before for e in evaluator.episodes([params], trial, K + 1, seed)]
    texts, lane_id = evaluator.told_of(trial).text[0], evaluator.lanes_of(trial).lane_id

    @jax.jit
    def posterior_of(belief):
        one_policy = jax.tree.map(lambda x: x[0], belief)
        given = jnp.ones(len(texts))
        return inference.posterior_of_belief(params.encoder_params, one_policy, texts, given)

    @jax.jit
    def draw(posterior):
        key = jax.random.fold_in(jax.random.key(seed), K)
        noise = z_noise(agent_keys(key, lane_id), inference.latent_dim)
        return inference.z_of_noise(posterior, noise)

    def by_task(x: jax.Array) -> np.ndarray:
        return np.asarray(x).reshape(len(trial.tasks), -1, *x.shape[1:])

    def nats(posterior: Gaussian) -> np.ndarray | None:
        if not session.config.encoder.information_bottleneck:
            return None
        return by_task(jnp.sum(kl_to_standard_normal(posterior), -1)).mean(1)

    own, text = posterior_of(memories[K].belief), posterior_of(memories[0].belief)
    reads_text = inference.has_goal_factor
    return Latents(
        mean=by_task(own.mean),
        z=by_task(draw(own)),
        kl=nats(own),
        text_mean=by_task(text.mean)[:, 0] if reads_text else None,  # one sentence a task
        text_kl=nats(text) if reads_text else None,
    )


def mean_routing(
    session: Session, learner: Learner, params: PolicyParams, lanes: Lanes, zc: jax.Array
) -> Routing | None:
    """The actor's routing in an episode of every lane, mean over its steps, (lane, ...).

    Args:
        zc: conditioning (lane, conditioning).

    Returns:
        None for an actor without modules.
    """
    env, horizon = session.env, session.config.env.horizon

    @jax.jit
    def play(params: PolicyParams, lanes: Lanes, zc: jax.Array):
        policy, key = (params.actor_params, params.obs_stats), jax.random.key(0)  # draws nothing
        act = lambda obs, key, noise: learner.policy(*policy, obs, zc, key, True)[0]
        state = jax.vmap(env.reset_to)(lanes.env_task, lanes.goal)
        _, episode, _ = rollout(env, act, state, key, horizon, horizon)
        routing_at = lambda obs: learner.policy(*policy, obs, zc, key, True)[1]
        routing = jax.vmap(routing_at)(episode.obs)  # (time, lane, ...)
        return jax.tree.map(lambda x: x.mean(0), routing)

    return play(params, lanes, zc)


def usage_of(routing: Routing | None, tasks: int) -> Usage | None:
    """Use of modules by task, from the mean routing of lanes (lane, ...) in the order of tasks."""
    if routing is None:
        return None

    def by_task(x: jax.Array) -> np.ndarray:
        return np.asarray(x).reshape(tasks, -1, *x.shape[1:]).mean(1)

    matrices, final = by_task(routing.matrices), by_task(routing.final)

    def with_output(layers: np.ndarray) -> np.ndarray:
        return np.concatenate([layers, final[:, None]], axis=1)  # the output is one reader

    # Over targets; sources are the last axis.
    return Usage(
        mean=with_output(matrices.mean(-2)),
        low=with_output(matrices.min(-2)),
        high=with_output(matrices.max(-2)),
    )
