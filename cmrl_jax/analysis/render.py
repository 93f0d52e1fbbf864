"""`train.py render`: one adaptation run per task as the evaluation runs it, filmed in Meta-World.

The physics is MuJoCo C on Meta-World's unmodified scenes. Scores and actions come from `Evaluator`,
so a film shows what a figure of `eval --physics native` counts; only its environment also tells the
host every state it passes through.
"""

from __future__ import annotations

import collections
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cmrl_jax.analysis.film import Camera, Episode, Film, write_sheet, write_video
from cmrl_jax.analysis.film_options import FilmOptions
from cmrl_jax.config.schema import as_config_error
from cmrl_jax.evaluation.evaluator import Evaluator
from cmrl_jax.evaluation.options import EvalOptions
from cmrl_jax.evaluation.session import Policy, Session, load_policy, prepare_jax
from cmrl_jax.evaluation.trials import evaluation_config, trial_of
from envs.physics.base import settled_starts
from envs.physics.native import unpack
from envs.sawyer import Ml4Env, State
from envs.tasks import task_id


class FilmedEnv(Ml4Env):
    """The environment on native physics; what each control step leads to is kept on the host.

    A lane is known by its task and placement, so no two lanes of an evaluation may share both.
    """

    def __init__(self, goal_observable: bool = False, obs_mode: str = "metaworld"):
        super().__init__(goal_observable, "native", obs_mode)
        # (task, placement) -> step -> its qpos and success in every episode so far.
        self._seen: dict[Any, dict[int, list[tuple[np.ndarray, bool]]]] = collections.defaultdict(
            lambda: collections.defaultdict(list)
        )

    def step(self, state: State, action: jax.Array) -> State:
        """One control step, as the environment's own."""
        new = super().step(state, action)
        # The step number tells where a state belongs: calls may come in any order.
        jax.debug.callback(self._keep, new.task_id, new.steps, new.physics, new.success)
        return new

    def _keep(self, task: Any, step: Any, physics: Any, success: Any) -> None:
        qpos = unpack(physics.replace(words=np.asarray(physics.words)))["qpos"]
        row = np.array(qpos), bool(success)
        self._seen[_lane(int(task), physics.placement)][int(step)].append(row)

    def episodes(self, task: str, placement: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """qpos (H + 1, 10) and success (H + 1,) of every episode of a lane, the start in row 0."""
        jax.effects_barrier()
        index = task_id(task)
        by_step = self._seen[_lane(index, placement)]
        steps = [by_step[step] for step in range(1, len(by_step) + 1)]
        start = settled_starts().qpos[index]
        found = []
        for rows in zip(*steps, strict=True):
            qpos, success = zip(*rows, strict=True)
            found.append((np.stack([start, *qpos]), np.array([False, *success])))
        return found


def _lane(task: int, placement: Any) -> tuple[int, bytes]:
    return task, np.asarray(placement, np.float32).tobytes()


def film_run(session: Session, policy: Policy, options: FilmOptions, caption: str) -> list[Film]:
    """Runs k exploration episodes and the reported one of every task asked for.

    Args:
        caption: where the policy comes from.
    """
    env = FilmedEnv(session.config.env.goal_observable, session.config.env.obs_mode)
    tasks, agent = options.tasks or session.eval_tasks, session.agent_of(options.adapt)
    evaluator = Evaluator(session.config, env, agent, len(tasks), options.horizon)
    shown = EvalOptions(goals=options.goal + 1, goal_set=options.goal_set, adapt=options.adapt)
    trial = trial_of([policy], session, shown, tasks).of_goal(options.goal)
    run, k = [policy.params], options.k
    played = list(evaluator.episodes(run, trial, k + 1, options.seed, counted=(k,)))
    films = []
    for row, task in enumerate(tasks):
        place = trial.placements[row, 0]
        episodes = tuple(
            Episode(
                f"reported, k = {k}" if e.is_counted else f"exploration {e.number + 1} of {k}",
                qpos,
                success,
                float(e.score.returns[0, row, 0, 0]),
                acted_on[row],
            )
            for e, acted_on, (qpos, success) in zip(
                played,
                [_acted_on(agent, e.after) for e in played],
                env.episodes(task, place),
                strict=True,
            )
        )
        held_out = "" if task in session.config.tasks.train else "held out, "
        where = f"{held_out}goal {options.goal} of '{options.goal_set}'; {caption}"
        films.append(Film(task, where, place, episodes))
    return films


def _acted_on(agent: Any, memory: Any) -> list[str]:
    """What each lane of the one policy was acted on in an episode, if the agent says so."""
    of_policy = jax.tree.map(lambda x: x[0], memory)
    if hasattr(agent, "describe"):
        return agent.describe(of_policy)
    return [""] * len(jax.tree.leaves(of_policy)[0])


def render_run(run: Path, options: FilmOptions, out: Path) -> int:
    """Writes TASK.mp4 and TASK.png of every task to `out`; returns the exit code.

    Raises:
        ConfigError: no such checkpoint, or it does not fit this program.
    """
    config = evaluation_config(run, "native")
    print(f"device: {prepare_jax(config)}", flush=True)
    session = Session(config)
    policy = load_policy(run, session, options.checkpoint)
    steps = f"iteration {policy.meta['iteration']}, {policy.meta['env_steps']:,} env steps"
    caption = f"{config.name}, {steps}"
    films = film_run(session, policy, options, caption)
    for film in films:
        video, sheet = out / f"{film.task}.mp4", out / f"{film.task}.png"
        with Camera(film) as camera, as_config_error():
            write_video(film, camera, options.every, video)
            write_sheet(film, camera, sheet, options.rows)
        sizes = ", ".join(
            f"{path} ({path.stat().st_size / 1000:.0f} kB)" for path in (video, sheet)
        )
        print(f"{film.task}: {film.episodes[-1].outcome}: {sizes}", flush=True)
    return 0
