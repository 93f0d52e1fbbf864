"""How policies are scored, and whether a run can be scored so; read before jax is imported."""

from __future__ import annotations

import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from cmrl_jax.commands import shown
from cmrl_jax.config.files import run_config
from cmrl_jax.config.rules import check_goal_set
from cmrl_jax.config.schema import (
    MOST_EPISODES,
    MOST_STEPS,
    Config,
    ConfigError,
    call_envs,
    require,
)
from cmrl_jax.registry import environment, rules_of, task_names
from cmrl_jax.storage.run_dir import find_run
from envs.command_line import LARGEST, brief, suggest, what_is
from envs.goal_names import GOALS, LARGEST_SEED
from envs.tasks import METAWORLD_TASKS


class ZControl(NamedTuple):
    """A way to choose what an episode is acted on: a value of `--z`.

    Attributes:
        help: in a few words.
        is_donated: whether it is another lane's belief, so that lanes depend on one another.
    """

    help: str
    is_donated: bool = False


ZSource = Literal["posterior", "prior", "shuffled", "other", "text"]
Z_CONTROLS: dict[ZSource, ZControl] = {
    "posterior": ZControl("the own experience"),
    "prior": ZControl("no text, no experience"),
    "shuffled": ZControl("another lane's posterior", is_donated=True),
    "other": ZControl("another task's", is_donated=True),
    "text": ZControl("no experience"),
}
DONATED = tuple(name for name, control in Z_CONTROLS.items() if control.is_donated)
Adapt = Literal["posterior", "search", "arms"]
ADAPT: tuple[Adapt, ...] = typing.get_args(Adapt)
SEARCH_K = (0, 1, 2, 5, 10, 20)  # where a search is scored unless --k says otherwise
# A draw is one of the numbers that name a lane's noise, in 32 bits (`evaluator.lane_names`), and
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
        z: what an episode is acted on; posterior is the protocol, the others are controls
            (controls.py).
        adapt: what own episodes change: the belief over z, or which arm is chosen (a z and a way to
            see the scene, `algorithms/cmrl/search.py`); arms: a control, after k episodes comes the
            k-th arm, whatever they earn.
        protocol: goal: each goal is adapted to by itself; task: each draw adapts once, on goals of
            the `train` set, and is scored on all goals.
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
    z: ZSource = "posterior"
    adapt: Adapt = "posterior"
    protocol: Literal["goal", "task"] = "goal"
    paraphrases: Literal["train", "heldout"] = "train"
    text_control: Literal["none", "shuffled", "zero"] = "none"
    text: str | None = None
    weights: Path | None = None
    any_table: bool = False
    lanes: int | None = None
    adaptation_episodes: int = 10
    evaluation_episodes: int = 3


def check_options(options: EvalOptions) -> None:
    """Whether the options are such as some run could be evaluated by.

    Raises:
        ConfigError: a value out of range, an unknown name, or options that contradict each other.
    """
    _check_values(options)
    check_goal_set(options.goal_set, "--goal-set")
    for task in options.tasks or ():
        if task not in task_names():
            cure = f"{suggest(task, task_names())}valid: {', '.join(task_names())}"
            raise ConfigError(f"unknown task '{task}' in --tasks", cure)
    for flag, values in (("tasks", options.tasks), ("k", options.k)):
        if values is not None and (not values or len(set(values)) < len(values)):
            raise ConfigError(f"--{flag} is '{shown(values)}'", "name at least one, each once")
    changed = [
        flag
        for flag, value, default in (
            ("--paraphrases", options.paraphrases, "train"),
            ("--text-control", options.text_control, "none"),
        )
        if value != default
    ]
    if options.text is not None and not options.text.strip():
        cure = "write a sentence, or --text-control zero for a policy that is told nothing"
        raise ConfigError("--text is empty", cure)
    if options.text is not None and changed:
        raise ConfigError(f"--text with {changed[0]}", "give one of the two: each names the text")
    if options.weights is not None and what_is(options.weights) != "directory":
        cause = f"--weights {brief(options.weights)} is no directory"
        raise ConfigError(cause, "give the one that holds the text encoder's model")
    if options.protocol == "task":
        cause = "--protocol task with --goal-set train: those are the goals it learns on"
        require(options.goal_set != "train", cause, "leave --goal-set out, or name another")
        cause = f"--protocol task with --z {options.z}: goals of a task share what they know"
        require(options.z not in DONATED, cause, "use --protocol goal")
        cause = "--protocol task with --paraphrases heldout: goals of a task share a sentence"
        require(options.paraphrases == "train", cause, "use --protocol goal")
        cause = "--protocol task with --physics metaworld"
        cure = "use --protocol goal, which is Meta-World's own, or --physics native"
        require(options.physics != "metaworld", cause, cure)
    if options.physics == "metaworld" and options.z in DONATED:
        cause = f"--z {options.z} with --physics metaworld, where lanes know nothing of each other"
        raise ConfigError(cause, "use --z posterior, prior or text, or --physics native")


def _check_values(options: EvalOptions) -> None:
    """Ranges and names, which the command line's flags have looked at and a program has not."""
    ranges = {
        "k": (0, MOST_EPISODES),
        "goals": (1, GOALS),
        "draws": (1, MOST_DRAWS),
        "seed": (0, LARGEST_SEED),
        "horizon": (1, MOST_STEPS),
        "lanes": (1, LARGEST),
    }
    for name, (low, high) in ranges.items():
        value = getattr(options, name)
        for number in value if name == "k" and value is not None else (value,):
            if number is None and name in ("k", "horizon", "lanes"):
                continue
            if type(number) is not int or not low <= number <= high:
                cause = f"{name} is {brief(repr(value))}"
                raise ConfigError(cause, f"give whole numbers from {low} to {high}")
    for name, hint in typing.get_type_hints(EvalOptions).items():
        choices = [c for h in (hint, *typing.get_args(hint)) for c in _words(h)]
        if choices and getattr(options, name) not in (None, *choices):
            cause = f"{name} is {brief(repr(getattr(options, name)))}"
            raise ConfigError(cause, f"valid: {', '.join(choices)}")


def _words(hint: Any) -> tuple[str, ...]:
    return typing.get_args(hint) if typing.get_origin(hint) is Literal else ()


def check_run(options: EvalOptions, run: Path) -> Config:
    """The configuration of a run, if it can be evaluated by these options.

    Raises:
        ConfigError: no run there, or one to which an option does not apply.
    """
    config = run_config(find_run(run))
    rules = call_envs(lambda: rules_of(config))
    k = ks_of(options, config)
    tasks = evaluated_tasks(options, config)
    own = environment(config.env.name).tasks
    for task in tasks:
        cure = f"name tasks of {config.env.name}: {', '.join(own)}"
        require(task in own, f"--tasks {task}: another environment's than the run's", cure)
        cause = f"--physics metaworld with the task {task} ({run}), which Meta-World has not"
        is_there = options.physics != "metaworld" or task in METAWORLD_TASKS
        require(is_there, cause, "leave --physics out, or name other tasks")
    is_way = options.adapt == EvalOptions.adapt or options.adapt in rules.ways
    cause = f"--adapt {options.adapt} with {rules.kind} ({run})"
    require(is_way, cause, f"leave it out, or use one of: {', '.join(rules.ways)}")
    if not rules.adapts:
        told = f"with {rules.kind} ({run})"
        if any(k):
            raise ConfigError(f"--k {shown(k)} {told}", "give --k 0: it does not adapt")
        if options.z != "posterior":
            raise ConfigError(f"--z {options.z} {told}", "leave --z out: the policy has no latent")
        if options.adaptation_episodes not in (0, EvalOptions.adaptation_episodes):
            cause = f"--adaptation-episodes {options.adaptation_episodes} {told}"
            raise ConfigError(cause, "leave it out: it does not adapt")
        for task in tasks:
            cure = f"use its training tasks: {', '.join(config.tasks.train)}"
            require(
                task in config.tasks.train, f"--tasks {task} {told}, which cannot know it", cure
            )
    wants_text = (
        options.text is not None
        or options.paraphrases != "train"
        or options.text_control != "none"
        or options.z == "text"
    )
    if wants_text and not rules.reads_text:
        raise ConfigError(f"a text option with a policy that reads no text ({run})", "leave it out")
    if options.z == "text" and not rules.can_start_from_text:
        cause = f"--z text with {rules.kind} ({run}): no experience, no text"
        raise ConfigError(cause, "use --z prior, which is the same there")
    if options.z == "shuffled" and len(tasks) * options.goals * options.draws < 2:
        raise ConfigError("--z shuffled with one lane", "give more tasks, goals or draws")
    if options.z == "other" and len(tasks) < 2:
        raise ConfigError("--z other with one task", "give at least two: --tasks A,B")
    if options.text is not None and config.goals.table in ("one-hot", "zero"):
        cause = f"--text with goals.table {config.goals.table} ({run}), which has no encoder"
        raise ConfigError(cause, "leave --text out")
    return config


def ks_of(options: EvalOptions, config: Config) -> tuple[int, ...]:
    """Numbers of adaptation episodes to score at: those asked for, else what is usual."""
    if options.k is not None:
        return options.k
    return SEARCH_K if options.adapt != "posterior" else config.eval.final_k


def evaluated_tasks(options: EvalOptions, config: Config) -> tuple[str, ...]:
    """The tasks to evaluate a run on: those asked for, else its training and test tasks."""
    return options.tasks or config.tasks.train + config.tasks.test
