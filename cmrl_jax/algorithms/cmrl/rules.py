"""What the program asks of a CMRL configuration before jax is imported.

PEARL, MTSAC and SAC are configurations of CMRL: `model.conditioning` is z, task_id or none.
"""

from __future__ import annotations

import math

from cmrl_jax.algorithms.rules import AlgorithmRules
from cmrl_jax.config.schema import LARGEST_RING, Config, lanes_per_task, require


class Rules(AlgorithmRules):
    """Answers about one CMRL configuration, see `AlgorithmRules`."""

    IDLE = (
        "kl.",
        "collect.lanes",
        "collect.updates_per_vector_step",
        "collect.group_frac",
        "collect.noise_correlation",
        "collect.noise_scale",
        "collect.scatter",
        "collect.initial",
        "collect.context_source",
        "collect.context_episodes",
        "collect.context_lanes",
        "sac.variant",
        "sac.alpha",
        "sac.alpha_init",
        "sac.target_entropy",
        "sac.gamma",
        "sac.tau",
        "sac.n_step",
        "sac.reward_scale",
        "sac.reward_norm",
        "sac.return_max",
        "sac.task_reduce",
        "sac.loss_balance",
        "sac.policy_reg",
        "sac.policy_average",
        "sac.batch",
        "sac.task_rows",
        "sac.lr",
        "sac.grad_clip",
    )

    def __init__(self, config: Config):
        super().__init__(config)
        conditioning, fusion = config.model.conditioning, config.encoder.goal_fusion
        self.adapts = conditioning == "z"
        self.reads_text = self.adapts and fusion != "none"
        self.can_start_from_text = self.adapts and fusion in ("factor", "both")
        self.ways = ("posterior", "search", "arms") if self.adapts else ("posterior",)
        self.is_told_the_task = conditioning == "task_id"
        self.kind = f"model.conditioning {conditioning}"
        if self.adapts:
            self.kind = f"encoder.goal_fusion {fusion}"

    seed_and_length_shape = False
    on_bad_gradients = "start a new run with a lower sac.lr"

    def check(self) -> None:
        """Raises ConfigError for the first combination that cannot be trained."""
        _check_model(self.config)
        _check_sizes(self.config)
        super().check()

    def check_devices(self, devices: int) -> None:
        """Raises ConfigError unless lanes, rings and batches divide evenly among the devices."""
        _check_devices(self.config, devices)


def lane_groups(config: Config) -> tuple[int, int, int]:
    """Lanes of one task whose z comes from prior, text and posterior; without z, all are prior.

    Largest remainders: the counts sum to the lanes of a task and differ from the shares by less
    than one lane.
    """
    lanes = lanes_per_task(config)
    if config.model.conditioning != "z":
        return lanes, 0, 0
    exact = [share * lanes for share in config.collect.group_frac]
    counts = [math.floor(x + 1e-9) for x in exact]
    by_remainder = sorted(range(3), key=lambda i: counts[i] - exact[i])
    for i in by_remainder[: lanes - sum(counts)]:
        counts[i] += 1
    return counts[0], counts[1], counts[2]


def context_writers(config: Config) -> int:
    """Lanes of a task whose episodes the context ring takes in."""
    is_prior_alone = config.collect.context_lanes == "prior"
    return lane_groups(config)[0] if is_prior_alone else lanes_per_task(config)


def _check_model(config: Config) -> None:
    model, encoder = config.model, config.encoder
    cause = f"model.modules is {list(model.modules)}"
    cure = "give at least 2 layers of 2 modules, or set model.net: mlp"
    require(model.modules[0] >= 2 and model.modules[1] >= 2, cause, cure)
    if model.net == "soft":
        cause = "model.net soft with model.conditioning none: nothing to route by"
        require(model.conditioning != "none", cause, "set model.net: mlp, or model.conditioning: z")
        cause = "model.net soft with neither modular_actor nor modular_critic"
        require(model.modular_actor or model.modular_critic, cause, "set model.net: mlp")
    alone = encoder.aux == "contrastive" and len(config.tasks.train) < 2
    cause = "encoder.aux contrastive with one training task: nothing to tell it from"
    require(not alone, cause, "name a second task in tasks.train, or set encoder.aux: none")
    cause = f"encoder.aux {encoder.aux} with model.conditioning {model.conditioning}: no z to train"
    cure = "set encoder.aux: none, or model.conditioning: z"
    require(encoder.aux == "none" or model.conditioning == "z", cause, cure)
    require(bool(model.mlp_hidden), "model.mlp_hidden is empty", "give at least one width")
    require(bool(encoder.hidden), "encoder.hidden is empty", "give at least one width")
    cause = f"sac.variant v with model.critic {model.critic}"
    cure = "set model.critic: mse, or sac.variant: twin_q"
    require(config.sac.variant != "v" or model.critic == "mse", cause, cure)
    if model.conditioning == "z" and encoder.goal_fusion in ("none", "concat"):
        fusion = f"encoder.goal_fusion {encoder.goal_fusion}"
        text = config.collect.group_frac[1]
        cause = f"collect.group_frac gives {text} of the lanes to text with {fusion}"
        cure = "set collect.group_frac: [0.5, 0.0, 0.5], or encoder.goal_fusion: both"
        require(text == 0, cause, cure)
        cause = f"encoder.aux contrastive with {fusion}: no text to pair experience with"
        cure = "set encoder.aux: none, or encoder.goal_fusion: both"
        require(encoder.aux != "contrastive", cause, cure)
        cause = f"encoder.p_empty is {encoder.p_empty} with {fusion}"
        cure = "set encoder.p_empty: 0.0, or encoder.goal_fusion: both"
        require(encoder.p_empty == 0, cause, cure)


def _check_sizes(config: Config) -> None:
    collect, horizon = config.collect, config.env.horizon
    shares, lanes = collect.group_frac, lanes_per_task(config)
    cause = f"collect.group_frac {list(shares)} sums to {sum(shares):g}"
    require(abs(sum(shares) - 1) < 1e-6, cause, "give three shares that sum to 1")
    if config.model.conditioning == "z":
        starved = any(s > 0 and n == 0 for s, n in zip(shares, lane_groups(config), strict=True))
        cause = f"the {lanes} lanes of a task cannot be split into the shares {list(shares)}"
        cure = "raise collect.lanes, or set the smallest share of collect.group_frac to 0"
        require(not starved, cause, cure)
    cause = f"env.horizon {horizon} is not a multiple of collect.chunk {collect.chunk}"
    cure = f"set collect.chunk: {_divisor(horizon, collect.chunk)}"
    require(horizon % collect.chunk == 0, cause, cure)
    cause = f"sac.n_step {config.sac.n_step} is longer than env.horizon {horizon}"
    require(config.sac.n_step <= horizon, cause, f"set sac.n_step to at most {horizon}")
    capacity = config.train.capacity
    cause = f"sac.batch {config.sac.batch} is over train.capacity {capacity}"
    require(config.sac.batch <= capacity, cause, "lower sac.batch or raise train.capacity")
    episode = horizon * lanes
    cause = f"train.capacity {capacity} is below one episode of the {lanes} lanes of a task"
    require(capacity >= episode, cause, f"set train.capacity: {episode} or a larger multiple of it")
    ring = collect.context_episodes * episode
    cause = f"collect.context_episodes {collect.context_episodes} of {episode} steps: {ring} slots"
    cure = f"set collect.context_episodes to at most {LARGEST_RING // episode}"
    require(ring <= LARGEST_RING, cause, cure)
    cause = f"train.capacity {capacity} is not a multiple of the {lanes} lanes of a task"
    require(capacity % lanes == 0, cause, f"set train.capacity: {-(-capacity // lanes) * lanes}")


def _divisor(number: int, most: int) -> int:
    """The largest divisor of a number that is not above `most`."""
    small = [d for d in range(1, math.isqrt(number) + 1) if number % d == 0]
    return max(d for low in small for d in (low, number // low) if d <= most)


def _check_devices(config: Config, devices: int) -> None:
    tasks, per_task = len(config.tasks.train), lanes_per_task(config)
    episode = config.env.horizon * context_writers(config)
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
        require(value * unit % devices == 0, cause, cure)
