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


def film_run(
    session: Session,
    policy: Policy,
    k: int,
    goal: int,
    goal_set: str,
    seed: int,
    horizon: int | None,
    caption: str,
) -> list[Film]:
    """Runs k exploration episodes and the reported one of every evaluated task.

    Args:
        goal: index into the goal set.
        caption: where the policy comes from.
    """
    env = FilmedEnv(session.config.env.goal_observable, session.config.env.obs_mode)
    tasks = session.eval_tasks
    evaluator = Evaluator(session.config, env, session.agent, len(tasks), horizon)
    options = EvalOptions(goals=goal + 1, goal_set=goal_set)
    trial = trial_of([policy], session, options, tasks).of_goal(goal)
    scores = evaluator.run([policy.params], trial, range(k + 1), seed)
    names = [f"exploration {i + 1} of {k}" for i in range(k)] + [f"reported, k = {k}"]
    films = []
    for row, task in enumerate(tasks):
        place = trial.placements[row, 0]
        episodes = tuple(
            Episode(name, qpos, success, float(scores[i].returns[0, row, 0, 0]))
            for i, (name, (qpos, success)) in enumerate(
                zip(names, env.episodes(task, place), strict=True)
            )
        )
        held_out = "" if task in session.config.tasks.train else "held out, "
        where = f"{held_out}goal {goal} of '{goal_set}'; {caption}"
        films.append(Film(task, where, place, episodes))
    return films


def render_run(
    run: Path,
    k: int,
    goal: int,
    goal_set: str,
    seed: int,
    horizon: int | None,
    checkpoint: int | None,
    every: int,
    out: Path,
) -> int:
    """Writes TASK.mp4 and TASK.png of every evaluated task to `out`; returns the exit code.

    Args:
        k: exploration episodes.
        goal: index into the goal set.
        horizon: control steps an episode; None for the run's own.
        checkpoint: iteration; None for the newest.
        every: control steps from one frame of a video to the next.

    Raises:
        ConfigError: no such checkpoint, or it does not fit this program.
    """
    config = evaluation_config(run, "native")
    print(f"device: {prepare_jax(config)}", flush=True)
    session = Session(config)
    policy = load_policy(run, session, checkpoint)
    steps = f"iteration {policy.meta['iteration']}, {policy.meta['env_steps']:,} env steps"
    caption = f"{config.name}, {steps}"
    films = film_run(session, policy, k, goal, goal_set, seed, horizon, caption)
    for film in films:
        video, sheet = out / f"{film.task}.mp4", out / f"{film.task}.png"
        with Camera(film) as camera, as_config_error():
            write_video(film, camera, every, video)
            write_sheet(film, camera, sheet)
        sizes = ", ".join(
            f"{path} ({path.stat().st_size / 1000:.0f} kB)" for path in (video, sheet)
        )
        print(f"{film.task}: {film.episodes[-1].outcome}: {sizes}", flush=True)
    return 0
