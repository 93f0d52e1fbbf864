"""`train.py render`: one adaptation run per task as the evaluation runs it, filmed in Meta-World.

The physics is MuJoCo C on Meta-World's unmodified scenes. Scores and actions come from `Evaluator`,
so a film shows what a figure of `eval --physics native` counts; only its environment also tells the
host every state it passes through.
"""

from __future__ import annotations

import collections
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cmrl_jax.checkpoint import policy_store
from cmrl_jax.config import Config
from cmrl_jax.config_io import read_yaml, resolve
from cmrl_jax.evaluate import Evaluator
from cmrl_jax.film import Camera, Episode, Film, write_sheet, write_video
from cmrl_jax.metrics import package_versions
from cmrl_jax.session import Session, policy_params, prepare_jax
from envs.native import unpack
from envs.physics import settled_starts
from envs.sawyer import Ml4Env, State
from envs.tasks import task_id


class FilmedEnv(Ml4Env):
    """The environment on native physics; what each control step leads to is kept on the host.

    A lane is known by its task and placement, so no two lanes of an evaluation may share both.
    """

    def __init__(self, goal_observable: bool = False):
        super().__init__(goal_observable, physics="native")
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
    params: Any,
    goal_vectors: np.ndarray,
    k: int,
    goal: int,
    goal_set: str,
    seed: int,
    horizon: int | None,
    caption: str,
) -> list[Film]:
    """Runs k exploration episodes and the reported one of every evaluated task.

    Args:
        params: `PolicyParams` of the session's policy.
        goal_vectors: (task, G), the run's own.
        goal: index into the goal set.
        caption: where the policy comes from.
    """
    env = FilmedEnv(session.config.env.goal_observable)
    tasks = session.eval_tasks
    evaluator = Evaluator(
        session.config, env, session.learner, tasks, goal_vectors, len(tasks), horizon
    )
    # A z draw depends on the goal's place in the set, so those before it run along.
    placements = session.placements(goal_set, goal + 1)
    scores = evaluator.run(params, placements, range(k + 1), seed)
    names = [f"exploration {i + 1} of {k}" for i in range(k)] + [f"reported, k = {k}"]
    films = []
    for row, task in enumerate(tasks):
        place = placements[row, goal]
        episodes = tuple(
            Episode(name, qpos, success, float(scores[i].returns[row, goal]))
            for i, (name, (qpos, success)) in enumerate(
                zip(names, env.episodes(task, place), strict=True)
            )
        )
        held_out = "" if task in session.config.tasks.train else "held out, "
        where = f"{held_out}goal {goal} of '{goal_set}'; {caption}"
        films.append(Film(task, where, place, episodes))
    return films


def on_native(config: Config) -> Config:
    """The configuration with MuJoCo C as its physics: a policy does not know its simulator."""
    return replace(config, env=replace(config.env, physics="native", impl="jax"))


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
    config = on_native(resolve(*read_yaml(run / "config.yaml")))
    print(f"device: {prepare_jax(config)}", flush=True)
    session = Session(config)
    state = jax.eval_shape(session.learner.init, jax.random.key(0))
    vectors = jax.ShapeDtypeStruct(session.goals.vectors[:, 0].shape, np.float32)
    abstract = {"params": policy_params(state), "goal_vectors": vectors}
    with policy_store(run, read_only=True) as store:
        trees, meta = store.restore(
            {"policy": abstract}, step=checkpoint, versions=package_versions()
        )
    policy = trees["policy"]
    caption = f"{config.name}, iteration {meta['iteration']}, {meta['env_steps']:,} env steps"
    goal_vectors = np.asarray(policy["goal_vectors"])
    films = film_run(
        session, policy["params"], goal_vectors, k, goal, goal_set, seed, horizon, caption
    )
    for film in films:
        video, sheet = out / f"{film.task}.mp4", out / f"{film.task}.png"
        with Camera(film) as camera:
            write_video(film, camera, every, video)
            write_sheet(film, camera, sheet)
        sizes = ", ".join(
            f"{path} ({path.stat().st_size / 1000:.0f} kB)" for path in (video, sheet)
        )
        print(f"{film.task}: {film.episodes[-1].outcome}: {sizes}", flush=True)
    return 0
