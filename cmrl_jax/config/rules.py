"""Rules of the configuration that need more than a type: bounds, names, combinations.

Each broken rule is one `ConfigError`: what was got, and what to write instead. They run before
anything is compiled, and import neither jax nor mujoco.
"""

from __future__ import annotations

from cmrl_jax.config.schema import (
    GOAL_ABLATIONS,
    TEXT_ENCODERS,
    Config,
    call_envs,
    leaves,
    require,
)
from cmrl_jax.registry import environment, rules_of
from envs.command_line import LARGEST, suggest
from envs.goal_names import seed_of


def validate(config: Config) -> None:
    """The rules that need more than one key, and the bounds of each.

    Raises:
        ConfigError: with the cause and the cure, for the first rule that is broken.
    """
    _check_bounds(config)
    _check_tasks(config)
    check_goal_table(config.goals.table)
    _check_eval(config)
    cause = "train.env_steps and train.minutes are both 0: the run would never end"
    require(bool(config.train.env_steps or config.train.minutes), cause, "set one of them")
    lanes, trained = config.collect.lanes, len(config.tasks.train)
    cause = f"collect.lanes {lanes} is not divisible by the {trained} training tasks"
    require(lanes % trained == 0, cause, f"set collect.lanes: {-(-lanes // trained) * trained}")
    films, name = config.log.video_every, config.env.name
    cause = f"log.video_every {films} with env.name {name}"
    require(not films or name == "ml4", cause, "set it to 0: films show Meta-World's scenes")
    call_envs(lambda: rules_of(config)).check()


def _check_bounds(config: Config) -> None:
    for name, f, value in leaves(config):
        above, low, high = (f.metadata[bound] for bound in ("above", "low", "high"))
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, bool | str):
                continue
            lower = f"above {above}" if above is not None else f"at least {low}"
            inside = number > above if above is not None else number >= low
            if high is None and isinstance(number, int):
                high = LARGEST
            inside = inside and (high is None or number <= high)
            upper = "" if high is None else f" and at most {high}"
            require(inside, f"{name} is {number}", f"give {name} a value {lower}{upper}")


def _check_tasks(config: Config) -> None:
    tasks = config.tasks
    known = tuple(call_envs(lambda: environment(config.env.name)).tasks)
    for key, names in (("tasks.train", tasks.train), ("tasks.test", tasks.test)):
        for name in names:
            cure = f"{suggest(name, known)}valid: {', '.join(known)}"
            require(name in known, f"unknown task '{name}' in {key}", cure)
            require(names.count(name) == 1, f"task '{name}' stands twice in {key}", "name it once")
    require(bool(tasks.train), "tasks.train is empty", f"name one of {', '.join(known)}")
    for name in tasks.test:
        cause = f"task '{name}' is in tasks.train and in tasks.test"
        require(name not in tasks.train, cause, "a held-out task is never trained on: drop one")


def check_goal_table(table: str) -> None:
    """Raises ConfigError unless `table` is an encoder, an ablation or the path of an .npz."""
    valid = (*TEXT_ENCODERS, *GOAL_ABLATIONS)
    require(
        table in valid or table.endswith(".npz"),
        f"'{table}' (goals.table) is no goal table",
        f"{suggest(table, valid)}valid: {', '.join(valid)}, or the path of an .npz",
    )


def check_goal_set(name: str, key: str) -> None:
    """Raises ConfigError unless `name` is the one name of a goal set; see `goal_names.seed_of`."""
    call_envs(lambda: seed_of(name), f"{key} ")


def _check_eval(config: Config) -> None:
    evaluation = config.eval
    check_goal_set(evaluation.goal_set, "eval.goal_set")
    for key, ks in (("eval.k", evaluation.k), ("eval.final_k", evaluation.final_k)):
        require(bool(ks), f"{key} is empty", "give at least one count of adaptation episodes")
        require(len(set(ks)) == len(ks), f"{key} {list(ks)} repeats a count", "name each once")
