"""Rules of the configuration that need more than a type: bounds, options not built, combinations.

Each broken rule is one `ConfigError`: what was got, and what to write instead. They run before
anything is compiled, and import neither jax nor mujoco.
"""

from __future__ import annotations

import math

from cmrl_jax.config.schema import (
    GOAL_ABLATIONS,
    LARGEST_RING,
    TASKS,
    TEXT_ENCODERS,
    Config,
    ConfigError,
    call_envs,
    lane_groups,
    lanes_per_task,
    leaves,
    suggest,
)
from envs.command_line import LARGEST
from envs.goal_names import seed_of


def validate(config: Config) -> None:
    """The rules that need more than one key, and the bounds of each.

    Raises:
        ConfigError: with the cause and the cure, for the first rule that is broken.
    """
    _check_bounds(config)
    _check_tasks(config)
    check_goal_table(config.goals.table)
    _check_model(config)
    _check_sizes(config)
    _check_eval(config)


def _require(holds: bool, cause: str, cure: str) -> None:
    if not holds:
        raise ConfigError(cause, cure)


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
            _require(inside, f"{name} is {number}", f"give {name} a value {lower}{upper}")


def _check_tasks(config: Config) -> None:
    tasks = config.tasks
    for key, names in (("tasks.train", tasks.train), ("tasks.test", tasks.test)):
        for name in names:
            cure = f"{suggest(name, TASKS)}valid: {', '.join(TASKS)}"
            _require(name in TASKS, f"unknown task '{name}' in {key}", cure)
            _require(names.count(name) == 1, f"task '{name}' stands twice in {key}", "name it once")
    _require(bool(tasks.train), "tasks.train is empty", f"name one of {', '.join(TASKS)}")
    for name in tasks.test:
        cause = f"task '{name}' is in tasks.train and in tasks.test"
        _require(name not in tasks.train, cause, "a held-out task is never trained on: drop one")
    if config.model.conditioning != "z":
        cause = f"tasks.test is {list(tasks.test)} with model.conditioning {{}}"
        cause = cause.format(config.model.conditioning)
        cure = "set tasks.test: [], only a latent z can adapt to a task not trained on"
        _require(not tasks.test, cause, cure)


def _check_model(config: Config) -> None:
    model, encoder = config.model, config.encoder
    cause = f"model.modules is {list(model.modules)}"
    cure = "give at least 2 layers of 2 modules, or set model.net: mlp"
    _require(model.modules[0] >= 2 and model.modules[1] >= 2, cause, cure)
    if model.net == "soft":
        cause = "model.net soft with model.conditioning none: nothing to route by"
        _require(
            model.conditioning != "none", cause, "set model.net: mlp, or model.conditioning: z"
        )
        cause = "model.net soft with neither modular_actor nor modular_critic"
        _require(model.modular_actor or model.modular_critic, cause, "set model.net: mlp")
    alone = encoder.aux == "contrastive" and len(config.tasks.train) < 2
    cause = "encoder.aux contrastive with one training task: nothing to tell it from"
    _require(not alone, cause, "name a second task in tasks.train, or set encoder.aux: none")
    cause = f"encoder.aux {encoder.aux} with model.conditioning {model.conditioning}: no z to train"
    cure = "set encoder.aux: none, or model.conditioning: z"
    _require(encoder.aux == "none" or model.conditioning == "z", cause, cure)
    _require(bool(model.mlp_hidden), "model.mlp_hidden is empty", "give at least one width")
    _require(bool(encoder.hidden), "encoder.hidden is empty", "give at least one width")
    cause = f"sac.variant v with model.critic {model.critic}"
    cure = "set model.critic: mse, or sac.variant: twin_q"
    _require(config.sac.variant != "v" or model.critic == "mse", cause, cure)
    if model.conditioning == "z" and encoder.goal_fusion in ("none", "concat"):
        fusion = f"encoder.goal_fusion {encoder.goal_fusion}"
        text = config.collect.group_frac[1]
        cause = f"collect.group_frac gives {text} of the lanes to text with {fusion}"
        cure = "set collect.group_frac: [0.5, 0.0, 0.5], or encoder.goal_fusion: both"
        _require(text == 0, cause, cure)
        cause = f"encoder.aux contrastive with {fusion}: no text to pair experience with"
        cure = "set encoder.aux: none, or encoder.goal_fusion: both"
        _require(encoder.aux != "contrastive", cause, cure)
        cause = f"encoder.p_empty is {encoder.p_empty} with {fusion}"
        cure = "set encoder.p_empty: 0.0, or encoder.goal_fusion: both"
        _require(encoder.p_empty == 0, cause, cure)


def _check_sizes(config: Config) -> None:
    collect, tasks, horizon = config.collect, len(config.tasks.train), config.env.horizon
    cause = f"collect.lanes {collect.lanes} is not divisible by the {tasks} training tasks"
    up = -(-collect.lanes // tasks) * tasks
    _require(collect.lanes % tasks == 0, cause, f"set collect.lanes: {up}")
    shares, lanes = collect.group_frac, lanes_per_task(config)
    cause = f"collect.group_frac {list(shares)} sums to {sum(shares):g}"
    _require(abs(sum(shares) - 1) < 1e-6, cause, "give three shares that sum to 1")
    if config.model.conditioning == "z":
        starved = any(s > 0 and n == 0 for s, n in zip(shares, lane_groups(config), strict=True))
        cause = f"the {lanes} lanes of a task cannot be split into the shares {list(shares)}"
        cure = "raise collect.lanes, or set the smallest share of collect.group_frac to 0"
        _require(not starved, cause, cure)
    cause = f"env.horizon {horizon} is not a multiple of collect.chunk {collect.chunk}"
    cure = f"set collect.chunk: {_divisor(horizon, collect.chunk)}"
    _require(horizon % collect.chunk == 0, cause, cure)
    cause = f"sac.n_step {config.sac.n_step} is longer than env.horizon {horizon}"
    _require(config.sac.n_step <= horizon, cause, f"set sac.n_step to at most {horizon}")
    capacity = config.train.capacity
    cause = f"sac.batch {config.sac.batch} is over train.capacity {capacity}"
    _require(config.sac.batch <= capacity, cause, "lower sac.batch or raise train.capacity")
    episode = horizon * lanes
    cause = f"train.capacity {capacity} is below one episode of the {lanes} lanes of a task"
    _require(
        capacity >= episode, cause, f"set train.capacity: {episode} or a larger multiple of it"
    )
    ring = collect.context_episodes * episode
    cause = f"collect.context_episodes {collect.context_episodes} of {episode} steps: {ring} slots"
    cure = f"set collect.context_episodes to at most {LARGEST_RING // episode}"
    _require(ring <= LARGEST_RING, cause, cure)
    cause = f"train.capacity {capacity} is not a multiple of the {lanes} lanes of a task"
    _require(capacity % lanes == 0, cause, f"set train.capacity: {-(-capacity // lanes) * lanes}")
    cause = "train.env_steps and train.minutes are both 0: the run would never end"
    _require(bool(config.train.env_steps or config.train.minutes), cause, "set one of them")


def _divisor(number: int, most: int) -> int:
    """The largest divisor of a number that is not above `most`."""
    small = [d for d in range(1, math.isqrt(number) + 1) if number % d == 0]
    return max(d for low in small for d in (low, number // low) if d <= most)


def check_goal_table(table: str) -> None:
    """Raises ConfigError unless `table` is an encoder, an ablation or the path of an .npz."""
    valid = (*TEXT_ENCODERS, *GOAL_ABLATIONS)
    _require(
        table in valid or table.endswith(".npz"),
        f"'{table}' (goals.table) is no goal table",
        f"{suggest(table, valid)}valid: {', '.join(valid)}, or the path of an .npz",
    )


def check_devices(config: Config, devices: int) -> None:
    """Raises ConfigError unless lanes, rings and batches divide evenly among the devices."""
    tasks, per_task = len(config.tasks.train), lanes_per_task(config)
    prior_only = config.collect.context_lanes == "prior"
    episode = config.env.horizon * (lane_groups(config)[0] if prior_only else per_task)
    sizes = (
        ("collect.lanes", config.collect.lanes, tasks, 1),
        ("train.capacity", config.train.capacity, per_task, 1),
        ("collect.context_episodes", config.collect.context_episodes, 1, episode),
        ("sac.batch", config.sac.batch, 1, 1),
    )
    for name, value, multiple, unit in sizes:
        step = math.lcm(multiple, devices // math.gcd(devices, unit))
        cause = f"{name} {value} cannot be divided among {devices} devices"
        fewer = "show fewer devices (CUDA_VISIBLE_DEVICES, JAX_NUM_CPU_DEVICES)"
        cure = f"set {name}: {-(-value // step) * step}, or {fewer}"
        _require(value * unit % devices == 0, cause, cure)


def check_goal_set(name: str, key: str) -> None:
    """Raises ConfigError unless `name` is the one name of a goal set; see `goal_names.seed_of`."""
    call_envs(lambda: seed_of(name), f"{key} ")


def _check_eval(config: Config) -> None:
    evaluation = config.eval
    check_goal_set(evaluation.goal_set, "eval.goal_set")
    for key, ks in (("eval.k", evaluation.k), ("eval.final_k", evaluation.final_k)):
        _require(bool(ks), f"{key} is empty", "give at least one count of adaptation episodes")
        _require(len(set(ks)) == len(ks), f"{key} {list(ks)} repeats a count", "name each once")
        cause = f"{key} {list(ks)} with model.conditioning {config.model.conditioning}"
        cure = f"set {key}: [0], only a latent z can adapt"
        _require(config.model.conditioning == "z" or not any(ks), cause, cure)
