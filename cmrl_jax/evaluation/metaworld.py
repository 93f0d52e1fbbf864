"""`train.py eval --physics metaworld`: a policy in Meta-World's own environments.

Two figures, from the same agent (metaworld_agent.py) on the same goals:

* our protocol, success after k adaptation episodes, every episode of full length;
* the output of Meta-World's own `metalearning_evaluation`: adaptation episodes, then evaluation
  episodes that end at the first success. One call a task, with one environment that visits every
  goal: with several, its `evaluation` stops once enough episodes of the TASK are over, wherever
  they ran, and so counts the lanes that succeed early more often.

A run's own training process never comes here: this is a command of its own.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs.engine  # noqa: F401  # isort: skip, metaworld imports MuJoCo
from gymnasium.vector import SyncVectorEnv
from metaworld.evaluation import Timestep, metalearning_evaluation

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.evaluation.cells import Row
from cmrl_jax.evaluation.episode import Episode
from cmrl_jax.evaluation.evaluator import Trial, lane_names
from cmrl_jax.evaluation.metaworld_agent import MetaWorldAgent, is_recurrent
from cmrl_jax.evaluation.options import EvalOptions, evaluated_tasks, ks_of
from cmrl_jax.evaluation.scores import cell_rows, format_scores, summarise
from cmrl_jax.evaluation.session import Policy, Session, load_policy, prepare_jax
from cmrl_jax.evaluation.settings import describe, horizon_of, result_fields, row_columns
from cmrl_jax.evaluation.trials import evaluation_config, trial_of
from cmrl_jax.formats import format_duration
from envs.adapters.metaworld_envs import MAX_HORIZON, make_vector_env, set_goals
from envs.tasks import task_id

ENVIRONMENTS = 10  # side by side in our own protocol: 18 MB each, and one call of the policy


def evaluate_in_metaworld(
    run: Path, options: EvalOptions, checkpoint: int | None
) -> tuple[dict[str, Any], list[Row]]:
    """Scores a run's policy and prints both tables; returns the result as JSON has it, and cells.

    Raises:
        ConfigError: no such checkpoint, or an episode longer than Meta-World's.
    """
    config = evaluation_config(run, "native")  # the cheap one to build: its physics is not used
    horizon = horizon_of(options, config)
    if horizon > MAX_HORIZON:
        raise ConfigError(
            f"episodes of {horizon} steps, Meta-World's have at most {MAX_HORIZON}",
            f"give --horizon {MAX_HORIZON} or less",
        )
    print(f"device: {prepare_jax(config)}", flush=True)
    session = Session(config)
    policy = load_policy(run, session, checkpoint)
    tasks = evaluated_tasks(options, config)
    trial = trial_of([policy], session, options, tasks)
    k = ks_of(options, config)
    parts, own = [], {}
    for row, task in enumerate(tasks):
        started = time.monotonic()
        alone = of_task(trial, row)
        found = k_shot(
            session, policy, alone, k, horizon, options.seed, options.lanes, options.adapt
        )
        parts.append(found)
        own[task] = metaworlds_own(session, policy, alone, options, horizon)
        seconds = format_duration(time.monotonic() - started)
        print(
            f"{task}: Meta-World's own {own[task]['mean_success_rate']:.2f}, {seconds}", flush=True
        )
    scores = {
        n: jax.tree.map(lambda *x: np.concatenate(x), *(part[n] for part in parts)) for n in k
    }
    summary = summarise(scores, tasks)
    print(f"checkpoint {policy.meta['iteration']} of {run}: {describe(options, config)}")
    print(format_scores(summary))
    print(format_own(own))
    fields = result_fields(run, policy.meta, options, config)
    result = {"tasks": summary, "metalearning_evaluation": {"tasks": own}} | fields
    return result, cell_rows(scores, tasks, row_columns(run, policy.meta, options, config))


def of_task(trial: Trial, row: int) -> Trial:
    """One task of a trial."""
    one = slice(row, row + 1)
    return replace(
        trial,
        tasks=trial.tasks[one],
        placements=trial.placements[one],
        texts=trial.texts[:, one],
    )


def k_shot(
    session: Session,
    policy: Policy,
    trial: Trial,
    k: Sequence[int],
    horizon: int,
    seed: int,
    environments: int | None = None,
    adapt: str = "posterior",
) -> dict[int, Episode]:
    """Our protocol on a trial of one task: k -> Episode of (1, goal, draw).

    Batches of `environments` lanes (goal, draw), each at its goal throughout.

    Args:
        environments: side by side; None for `ENVIRONMENTS`.
        adapt: see `EvalOptions`.
    """
    [task] = trial.tasks
    goals, draws = trial.placements.shape[1], trial.draws
    goal, _ = (x.ravel() for x in np.indices((goals, draws)))
    placements = trial.placements[0][goal]
    lanes = min(environments or ENVIRONMENTS, len(goal))
    shown = session.config.env.goal_observable
    parts: dict[int, list[Episode]] = {n: [] for n in k}
    recurrent = is_recurrent(session.agent_of(adapt))
    envs = make_vector_env(task, placements[:lanes], lanes, horizon, shown, seed, recurrent)
    try:
        envs.call("toggle_terminate_on_success", False)
        batches = [
            np.minimum(np.arange(start, start + lanes), len(goal) - 1)
            for start in range(0, len(goal), lanes)
        ]
        agent = agent_of(session, policy, trial, batches, horizon, seed, adapt)
        for index in batches:
            set_goals(envs, task, placements[index], shown)
            agent.init()
            for number, episode in adaptation_run(agent, envs, k, horizon).items():
                parts[number].append(episode)
    finally:
        envs.close()
    shape = (1, goals, draws)
    join = lambda *x: np.concatenate(x)[: len(goal)].reshape(shape)
    return {n: jax.tree.map(join, *episodes) for n, episodes in parts.items()}


def agent_of(
    session: Session,
    policy: Policy,
    trial: Trial,
    runs: Sequence[np.ndarray],
    horizon: int,
    seed: int,
    adapt: str = "posterior",
) -> MetaWorldAgent:
    """The agent of a trial of one task, whose adaptation runs take these lanes of it in turn."""
    names, train = lane_names(trial, session.env.tasks), session.config.tasks.train
    [task] = trial.tasks
    if trial.z == "shuffled" or trial.z == "other":  # `check_options` has looked
        raise ValueError(f"z {trial.z}: lanes know nothing of each other here")
    env: Any = session.env  # Meta-World's own: `ml4`
    texts = np.repeat(trial.texts[0, 0], trial.draws, axis=0)  # (lane, G)
    return MetaWorldAgent(
        session.config.env,
        session.agent_of(adapt),
        policy.params,
        texts=np.stack([texts[lanes] for lanes in runs]),
        lane_ids=np.stack([names[lanes] for lanes in runs]),
        train_row=train.index(task) if task in train else 0,
        reset_lag=np.asarray(env.reset_lag(jnp.asarray(task_id(task)))),
        horizon=horizon,
        seed=seed,
        z=trial.z,
        deterministic=trial.deterministic,
    )


def format_own(own: dict[str, Any]) -> str:
    """The output of Meta-World's own function, a line a task."""
    [first, *_] = own.values()
    goals = f"{first['num_evals'] // first['draws']} goals"
    if first["draws"] > 1:
        goals += f", {first['draws']} runs each"
    lines = [
        f"metaworld.evaluation.metalearning_evaluation: {goals}, "
        f"{first['adaptation_episodes']} adaptation and {first['evaluation_episodes']} evaluation "
        f"episodes of {first['horizon']} steps, ended by success"
    ]
    for task, found in own.items():
        lines.append(f"{task:<14} {found['mean_success_rate']:>5.2f} {found['mean_return']:>8.0f}")
    return "\n".join(lines)


def adaptation_run(
    agent: MetaWorldAgent, envs: SyncVectorEnv, k: Sequence[int], horizon: int
) -> dict[int, Episode]:
    """Episodes of full length, one after the other: k -> the scores (lane,) after k of them.

    An agent that explores plays the episode that counts apart, and learns nothing from it.
    """
    found, obs = {}, envs.reset()[0]
    for number in range(max(k) + 1):
        if number in k and agent.explores:
            agent.adapt()
            found[number], obs = _episode(agent, envs, obs, horizon)
            agent.go_on_learning()
        if number < max(k) or not agent.explores:
            score, obs = _episode(agent, envs, obs, horizon)
            if number in k and not agent.explores:
                found[number] = score
    return found


def _episode(
    agent: MetaWorldAgent, envs: SyncVectorEnv, obs: np.ndarray, horizon: int
) -> tuple[Episode, np.ndarray]:
    """One episode from its first observation: its scores, and the next one's first observation."""
    rewards, successes, distance = [], [], np.zeros(envs.num_envs)
    for _ in range(horizon):
        actions, aux = agent.adapt_action(obs)
        next_obs, reward, terminated, truncated, info = envs.step(actions)
        agent.step(Timestep(obs, actions, reward, terminated, truncated, aux))
        verdict: Any = info["final_info"] if truncated.any() else info
        rewards.append(reward)
        successes.append(verdict["success"].astype(bool))
        distance = verdict["obj_to_target"]
        obs = next_obs
    success = np.array(successes)
    hit = success.any(0)
    score = Episode(
        success_any=hit,
        success_last=success[-1],
        returns=np.sum(rewards, 0),
        first_success=np.where(hit, success.argmax(0), horizon),
        final_distance=distance,
        faults=np.zeros(envs.num_envs, int),
    )
    return score, obs


def metaworlds_own(
    session: Session, policy: Policy, trial: Trial, options: EvalOptions, horizon: int
) -> dict[str, Any]:
    """What Meta-World's `metalearning_evaluation` says of the policy on a trial of one task."""
    [task] = trial.tasks
    placements = np.repeat(trial.placements[0], trial.draws, axis=0)  # a goal once for each draw
    shown = session.config.env.goal_observable
    recurrent = is_recurrent(session.agent_of(options.adapt))
    envs = make_vector_env(task, placements, 1, horizon, shown, options.seed, recurrent)
    # Goals come in the environment's own order: runs are numbered, sentences taken in turn.
    runs = [np.array([n]) for n in range(len(placements))]
    agent = agent_of(session, policy, trial, runs, horizon, options.seed, options.adapt)
    episodes = options.adaptation_episodes if session.agent_of(options.adapt).adapts else 0
    try:
        rate, mean_return, per_task = metalearning_evaluation(
            agent,
            envs,
            num_evals=len(placements),
            adaptation_steps=1,
            adaptation_episodes=episodes,
            evaluation_episodes=options.evaluation_episodes,
        )
    finally:
        envs.close()
    return {
        "mean_success_rate": float(rate),
        "mean_return": float(mean_return),
        "success_rate_per_task": {name: float(value) for name, value in per_task.items()},
        "num_evals": len(placements),
        "draws": trial.draws,
        "adaptation_steps": 1,
        "adaptation_episodes": episodes,
        "evaluation_episodes": options.evaluation_episodes,
        "horizon": horizon,
    }
