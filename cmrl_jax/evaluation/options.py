"""How policies are scored, and whether a run can be scored so; read before jax is imported."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cmrl_jax.commands import shown
from cmrl_jax.config.files import run_config
from cmrl_jax.config.schema import Config, ConfigError
from cmrl_jax.storage.run_dir import find_run
from envs.goal_names import GOALS

Z_SOURCES = ("posterior", "prior", "shuffled", "other", "text")


DONATED = ("shuffled", "other")  # z from another lane's belief: lanes depend on one another


# A draw is one of the numbers that name a lane's noise, in 32 bits (`evaluate.lane_names`), and
# every lane keeps its text in memory.
MOST_DRAWS = 10_000


@dataclass(frozen=True)
class EvalOptions:
    """How policies are scored, whichever they are; None takes the run's own value.

    Attributes:
        k: adaptation episodes.
        tasks: tasks to evaluate.
        goals: goals a task, the first of the set.
        goal_set: train, heldout or fresh:<seed>.
        draws: z draws a goal, each a lane of its own.
        seed: seed of the evaluation's draws.
        horizon: control steps an episode.
        physics: backend to evaluate in.
        policy: deterministic (tanh of the mean) or sampled actions.
        z: where z comes from; posterior is the protocol, the others are controls.
        paraphrases: sentences of the table, the first trained on or the held-out ones.
        text_control: whose sentence a lane is given: its task's, another task's, a zero vector.
        text: one sentence for every lane, in place of the table's.
        weights: folder of the text encoder's weights, where `text` needs them.
        any_table: take sentences from a goal table that is not the run's.
        lanes: parallel episodes in a batch.
        adaptation_episodes, evaluation_episodes: of Meta-World's own function.
    """

    k: tuple[int, ...] | None = None
    tasks: tuple[str, ...] | None = None
    goals: int = GOALS
    goal_set: str = "heldout"
    draws: int = 1
    seed: int = 0
    horizon: int | None = None
    physics: Literal["mjx", "native", "metaworld"] | None = None
    policy: Literal["deterministic", "sampled"] = "deterministic"
    z: Literal["posterior", "prior", "shuffled", "other", "text"] = "posterior"
    paraphrases: Literal["train", "heldout"] = "train"
    text_control: Literal["none", "shuffled", "zero"] = "none"
    text: str | None = None
    weights: Path | None = None
    any_table: bool = False
    lanes: int | None = None
    adaptation_episodes: int = 10
    evaluation_episodes: int = 3


def check_run(options: EvalOptions, run: Path) -> Config:
    """The configuration of a run, if it can be evaluated by these options.

    Raises:
        ConfigError: no run there, or one to which an option does not apply.
    """
    config = run_config(find_run(run))
    conditioning, fusion = config.model.conditioning, config.encoder.goal_fusion
    k = options.k if options.k is not None else config.eval.final_k
    tasks = evaluated_tasks(options, config)
    if conditioning != "z":
        told = f"with model.conditioning {conditioning} ({run})"
        if any(k):
            raise ConfigError(f"--k {shown(k)} {told}", "give --k 0: only a latent z can adapt")
        if options.z != "posterior":
            raise ConfigError(f"--z {options.z} {told}", "leave --z out: the policy has no latent")
        if options.adaptation_episodes not in (0, EvalOptions.adaptation_episodes):
            cause = f"--adaptation-episodes {options.adaptation_episodes} {told}"
            raise ConfigError(cause, "leave it out: only a latent z can adapt")
        for task in tasks:
            if task not in config.tasks.train:
                cure = f"use its training tasks: {', '.join(config.tasks.train)}"
                raise ConfigError(f"--tasks {task} {told}, which cannot know it", cure)
    wants_text = (
        options.text is not None
        or options.paraphrases != "train"
        or options.text_control != "none"
        or options.z == "text"
    )
    if wants_text and (conditioning != "z" or fusion == "none"):
        raise ConfigError(f"a text option with a policy that reads no text ({run})", "leave it out")
    if options.z == "text" and fusion == "concat":
        cause = f"--z text with encoder.goal_fusion concat ({run}): no experience, no text"
        raise ConfigError(cause, "use --z prior, which is the same there")
    if options.z == "shuffled" and len(tasks) * options.goals * options.draws < 2:
        raise ConfigError("--z shuffled with one lane", "give more tasks, goals or draws")
    if options.z == "other" and len(tasks) < 2:
        raise ConfigError("--z other with one task", "give at least two: --tasks A,B")
    if options.text is not None and config.goals.table in ("one-hot", "zero"):
        cause = f"--text with goals.table {config.goals.table} ({run}), which has no encoder"
        raise ConfigError(cause, "leave --text out")
    return config


def evaluated_tasks(options: EvalOptions, config: Config) -> tuple[str, ...]:
    """The tasks to evaluate a run on: those asked for, else its training and test tasks."""
    return options.tasks or config.tasks.train + config.tasks.test
