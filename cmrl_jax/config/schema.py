"""The configuration schema: frozen dataclasses whose defaults are the `cmrl` preset at CPU size.

Every key has its help text beside it (`doc`), which is what `train.py --help` prints. The rules
that span keys live in `rules.py`, reading YAML and flags in `files.py`. None of the three imports
jax or mujoco, so that a typo is reported at once.
Preset values and their sources: the comments in `configs/*.yaml`; formulas: docs/algorithm.md.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import Field, dataclass, field, fields, is_dataclass
from typing import Any, Literal

from envs.goal_names import GOALS, LARGEST_SEED

TEXT_ENCODERS = ("minilm-l6-v2", "clip-vit-b-32")  # the table of the first is packaged
GOAL_ABLATIONS = ("one-hot", "zero", "shuffled")
# Beyond these, what is counted in 32 bits (steps of an episode, episodes by which draws are named,
# slots of a ring and how far a window reaches past them) would wrap, or no memory would hold it.
MOST_STEPS = 100_000  # control steps of an episode
MOST_EPISODES = 10_000  # adaptation episodes, and episodes of fine-tuning
MOST_UPDATES = 10_000  # gradient steps a control step
LARGEST_RING = 2**30  # transitions of a task


class ConfigError(ValueError):
    """A user's configuration mistake: `cause` says what is wrong, `cure` what to do about it."""

    def __init__(self, cause: str, cure: str):
        super().__init__(f"{cause}\n{cure}")
        self.cause = cause
        self.cure = cure


def require(holds: bool, cause: str, cure: str) -> None:
    """Raises ConfigError unless a rule holds."""
    if not holds:
        raise ConfigError(cause, cure)


def call_envs(build: Callable[[], Any], about: str = "") -> Any:
    """Calls into `envs`, whose ValueErrors carry cause and cure on two lines."""
    with as_config_error(about):
        return build()


@contextlib.contextmanager
def as_config_error(about: str = "") -> Iterator[None]:
    """Such errors as ConfigErrors; `about` begins the cause, as the key that it stands under."""
    try:
        yield
    except ValueError as error:
        cause, _, cure = str(error).partition("\n")
        if not cure:
            raise
        raise ConfigError(f"{about}{cause}", cure) from error


def doc(
    default: Any, text: str, above: float | None = None, low: float = 0, high: float | None = None
) -> Any:
    """A dataclass field with its help text and the bounds of its number or of its numbers.

    `low <= value <= high`; with `above`, `value > above`. No number of the schema may be negative,
    and no whole number above `LARGEST` unless `high` says so.
    """
    bounds = {"above": above, "low": low, "high": high}
    return field(default=default, metadata={"doc": text, **bounds})


@dataclass(frozen=True)
class TasksConfig:
    train: tuple[str, ...] = doc(
        ("drawer-open", "drawer-close", "window-open"), "tasks that are trained on"
    )
    test: tuple[str, ...] = doc(("window-close",), "held-out tasks: evaluated, never trained on")


@dataclass(frozen=True)
class EnvConfig:
    name: str = doc("ml4", "registered environment; physics, goal_observable, obs_mode are ml4's")
    physics: Literal["mjx", "native"] = doc(
        "mjx", "mjx: on the device; native: MuJoCo C on the host, Meta-World's own contacts"
    )
    horizon: int = doc(
        200,
        "control steps an episode lasts; a time limit, never a terminal",
        above=0,
        high=MOST_STEPS,
    )
    goal_observable: bool = doc(False, "show the target position in the observation")
    variation: Literal["episode_random", "fixed_50"] = doc(
        "episode_random", "fixture position at reset: drawn afresh, or from the 50 `train` goals"
    )
    obs_mode: Literal["metaworld", "canonical"] = doc(
        "canonical", "relative to where the object began, or metaworld: as Meta-World's"
    )
    # Recorded so that a policy is never shown observations from another origin than it learned by.
    origin: Literal["settled"] = doc(
        "settled", "where canonical observations have it: the object as it stands after the reset"
    )


@dataclass(frozen=True)
class GoalsConfig:
    table: str = doc(
        "minilm-l6-v2",
        "text vectors: minilm-l6-v2, clip-vit-b-32 (once built) or the path of an .npz; "
        "one-hot, zero and shuffled are ablations",
    )


@dataclass(frozen=True)
class ModelConfig:
    net: Literal["soft", "mlp"] = doc("soft", "soft-modular network or a plain MLP")
    conditioning: Literal["z", "task_id", "none"] = doc("z", "what the networks are told")
    mlp_hidden: tuple[int, ...] = doc((128, 128), "hidden widths of the MLP network", above=0)
    modules: tuple[int, int, int] = doc(
        (2, 2, 64), "module layers, modules a layer, module width", above=0
    )
    trunk_width: int = doc(128, "D: trunk and z-embedding width", above=0)
    gating_width: int = doc(64, "Hg: width of the router's gating layers", above=0)
    router_input: Literal["z*obs", "z"] = doc("z", "what the router sees")
    trunk_input: Literal["obs", "obs_z"] = doc("obs", "what the trunk sees")
    router_temperature: float = doc(1.0, "softmax temperature of the routing", above=0)
    modular_actor: bool = doc(True, "soft-modular actor (false: MLP actor)")
    modular_critic: bool = doc(True, "soft-modular critics (false: MLP critics)")
    norm: Literal["none", "layer"] = doc("layer", "LayerNorm inside actor and critics")
    init: Literal["flax", "official"] = doc("flax", "initialisation scheme")
    critic: Literal["mse", "c51"] = doc("mse", "critic head and loss")
    critic_bins: int = doc(51, "bins of the categorical critic", low=2)
    critic_v_max: float = doc(12.5, "the categorical critic's support is [-v_max, v_max]", above=0)
    critic_agg: Literal["min", "mean"] = doc("mean", "target distribution over the twin critics")


@dataclass(frozen=True)
class EncoderConfig:
    hidden: tuple[int, ...] = doc((128, 128), "hidden widths of the context encoder", above=0)
    latent_dim: int = doc(8, "L: size of z", above=0)
    norm: Literal["none", "layer"] = doc("layer", "LayerNorm in the encoder")
    use_next_obs: bool = doc(True, "next observation in the context")
    goal_fusion: Literal["none", "concat", "factor", "both"] = doc("both", "how text enters q(z)")
    goal_width: int = doc(32, "Gp: width of the projected text vector", above=0)
    p_drop_goal: float = doc(0.0, "probability that a task's text is hidden in an update", high=1)
    poe: Literal["pearl", "prior_tempered"] = doc("prior_tempered", "product of Gaussians")
    n_eff: int = doc(32, "prior_tempered: context size above which evidence is tempered", above=0)
    context_len: Literal["random", "fixed"] = doc("random", "context size: log-uniform or N_max")
    context_max: int = doc(64, "N_max: context transitions an update", above=0)
    p_empty: float = doc(0.5, "probability of an empty context (needs a goal factor)", high=1)
    context_reward_scale: float = doc(0.1, "reward scale inside the context")
    information_bottleneck: bool = doc(True, "false: z is the mean of the factors, no KL")
    aux: Literal["none", "recon", "contrastive"] = doc(
        "contrastive",
        "z also learns recon: to predict reward and change of the observation over n_step steps; "
        "contrastive: which task's experience and which task's text belong together",
    )
    aux_weight: float = doc(0.1, "weight of the auxiliary loss")


@dataclass(frozen=True)
class KlConfig:
    beta: float = doc(1.0e-3, "weight of KL(q(z) || N(0, I))")
    reduce: Literal["mean_tasks", "sum_tasks"] = doc("mean_tasks", "reduction over task rows")
    free_bits: float = doc(0.0, "nats per latent dimension that cost nothing")


@dataclass(frozen=True)
class SacConfig:
    variant: Literal["twin_q", "v"] = doc("twin_q", "twin Q targets, or PEARL's V network")
    alpha: Literal["fixed", "shared", "per_task"] = doc("per_task", "entropy temperature")
    alpha_init: float = doc(0.01, "first (or fixed) temperature", above=0)
    target_entropy: float = doc(-0.5, "H_target, nats an action dimension", low=-10, high=1)
    gamma: float = doc(0.99, "discount a control step", above=0, high=1)
    tau: float = doc(0.005, "target update rate a gradient step", above=0, high=1)
    n_step: int = doc(3, "control steps in the Bellman target", low=1)
    reward_scale: float = doc(1.0, "multiplies the (normalised) reward", above=0)
    reward_norm: Literal["none", "global", "per_task"] = doc(
        "per_task", "return normalisation, rl2's too"
    )
    return_max: float = doc(10.0, "G_max: normalised returns stay within it, rl2's too", above=0)
    task_reduce: Literal["mean", "sum"] = doc("mean", "reduction of the losses over task rows")
    loss_balance: Literal["none", "sac_temp"] = doc("none", "task weights in the losses")
    policy_reg: float = doc(0.0, "L2 on the actor's mean and log std")
    batch: int = doc(128, "B: transitions per task row in an update", above=0)
    task_rows: int = doc(0, "task rows in an update, drawn with replacement; 0: each task once")
    lr: float = doc(3.0e-4, "Adam learning rate of every network", above=0)
    policy_average: float = doc(
        0.1,
        "what acts in evaluation is an average of actor and encoder over about this share of the "
        "gradient steps so far; 0: they themselves",
        high=1,
    )
    grad_clip: float = doc(1.0, "global-norm clip of every network; 0: none")
    normalize_obs: bool = doc(True, "running mean and std of the observations")


@dataclass(frozen=True)
class PpoConfig:
    gamma: float = doc(0.99, "discount a control step", above=0, high=1)
    gae_lambda: float = doc(0.95, "lambda of generalised advantage estimation", high=1)
    clip: float = doc(0.2, "epsilon: how far the ratio of two policies counts", above=0)
    epochs: int = doc(5, "passes over the data of an iteration", above=0, high=MOST_UPDATES)
    lr: float = doc(5.0e-4, "Adam learning rate", above=0)
    grad_clip: float = doc(0.5, "global-norm clip", above=0)
    entropy: float = doc(1.0e-3, "weight of the entropy before tanh, in the loss")
    std_init: float = doc(0.8, "first standard deviation of actions before tanh", above=0)


@dataclass(frozen=True)
class Rl2Config:
    episodes: int = doc(3, "episodes of a trial", above=0, high=MOST_EPISODES)
    width: int = doc(128, "width of the GRU's hidden state", above=0)
    hidden: int = doc(128, "width of the layers before and after it", above=0)
    minibatches: int = doc(4, "minibatches of whole trials a pass", above=0)
    value_weight: float = doc(0.5, "weight of the value's squared error")
    reward_scale: float = doc(0.1, "reward scale in the input")


@dataclass(frozen=True)
class MamlConfig:
    episodes: int = doc(
        8, "episodes of an inner step; a task's lanes are groups of so many", above=0, high=10_000
    )
    inner_steps: int = doc(1, "inner gradient steps of a trial", above=0, high=100)
    inner_lr: float = doc(0.1, "step size of an inner step", above=0)
    hidden: tuple[int, ...] = doc((64, 64), "hidden widths of the policy", above=0)
    kl: float = doc(5.0e-4, "weight of the KL from the policies that collected the inner data")


@dataclass(frozen=True)
class CollectConfig:
    lanes: int = doc(96, "E: parallel environments, equally many of each training task", above=0)
    chunk: int = doc(10, "control steps between two blocks of gradient steps", above=0)
    updates_per_vector_step: int = doc(
        4, "gradient steps per control step of all lanes", above=0, high=MOST_UPDATES
    )
    group_frac: tuple[float, float, float] = doc(
        (0.25, 0.25, 0.5), "shares of lanes whose z is drawn from prior, text, posterior", high=1
    )
    noise_correlation: float = doc(
        0.9, "correlation of a lane's exploration noise from one step to the next", high=0.999
    )
    noise_scale: float = doc(
        6.0,
        "exploration noise of a task's lanes: from the policy's own to this many times it",
        low=1,
    )
    scatter: int = doc(
        40,
        "steps of one random action that an episode begins with, at most (and half of it); 0: none",
        high=MOST_STEPS,
    )
    initial: Literal["random", "prior"] = doc("random", "actions of iteration 0")
    context_source: Literal["recent", "all"] = doc("recent", "context from last episodes, or all")
    context_episodes: int = doc(2, "episodes a lane that the recent context ring holds", above=0)
    context_lanes: Literal["all", "prior"] = doc("all", "lanes that write to the context ring")


@dataclass(frozen=True)
class TrainConfig:
    env_steps: int = doc(1_000_000, "control steps of all lanes together; 0: no limit", high=10**12)
    minutes: float = doc(0.0, "wall-time limit of the whole run, final evaluation apart; 0: none")
    capacity: int = doc(
        340_000,
        "replay transitions per task; a multiple of the lanes of a task",
        above=0,
        high=LARGEST_RING,
    )


@dataclass(frozen=True)
class EvalConfig:
    every: float = doc(0.1, "evaluate each such share of the run", above=0, high=1)
    wall_share: float = doc(
        0.1, "at most this share of the wall time goes to evaluation", above=0, high=1
    )
    goals: int = doc(10, "goals a task in the periodic evaluation", above=0, high=GOALS)
    k: tuple[int, ...] = doc(
        (0, 2), "adaptation episodes in the periodic evaluation", high=MOST_EPISODES
    )
    final_goals: int = doc(50, "goals a task in the final evaluation", above=0, high=GOALS)
    final_k: tuple[int, ...] = doc(
        (0, 1, 2), "adaptation episodes in the final evaluation", high=MOST_EPISODES
    )
    goal_set: str = doc("heldout", "named goal set: train, heldout or fresh:<seed>")
    seed: int = doc(0, "seed of the evaluation's own draws", high=LARGEST_SEED)


@dataclass(frozen=True)
class CheckpointConfig:
    minutes: float = doc(5.0, "wall minutes between two full checkpoints; 0: every iteration")
    keep: int = doc(2, "full checkpoints kept", above=0)
    policy_every: int = doc(
        20, "iterations between two policy checkpoints; the last is always kept", above=0
    )


@dataclass(frozen=True)
class LogConfig:
    tensorboard: bool = doc(False, "write TensorBoard events too")
    wandb: bool = doc(False, "log to Weights & Biases too; WANDB_MODE=offline needs no account")
    video_every: int = doc(0, "film the policy every so many iterations, in a process; 0: never")
    progress: bool = doc(True, "progress bar when the output is a terminal")


@dataclass(frozen=True)
class RuntimeConfig:
    compile_cache: str = doc("~/.cache/cmrl_jax", "persistent compilation cache; empty: off")
    matmul_precision: Literal["highest", "default"] = doc("highest", "TF32 harms contact physics")


@dataclass(frozen=True)
class Config:
    name: str = doc("cmrl", "name of the preset, recorded with the run")
    seed: int = doc(0, "seed of the whole run", high=LARGEST_SEED)
    algorithm: str = doc(
        "cmrl",
        "registered algorithm; model, encoder, kl, sac and most of collect are cmrl's, ppo is that "
        "of rl2 and maml",
    )
    tasks: TasksConfig = TasksConfig()
    env: EnvConfig = EnvConfig()
    goals: GoalsConfig = GoalsConfig()
    model: ModelConfig = ModelConfig()
    encoder: EncoderConfig = EncoderConfig()
    kl: KlConfig = KlConfig()
    sac: SacConfig = SacConfig()
    ppo: PpoConfig = PpoConfig()
    rl2: Rl2Config = Rl2Config()
    maml: MamlConfig = MamlConfig()
    collect: CollectConfig = CollectConfig()
    train: TrainConfig = TrainConfig()
    eval: EvalConfig = EvalConfig()
    checkpoint: CheckpointConfig = CheckpointConfig()
    log: LogConfig = LogConfig()
    runtime: RuntimeConfig = RuntimeConfig()


def leaves(config: Any, prefix: str = "") -> Iterator[tuple[str, Field, Any]]:
    """All (dotted name, dataclass field, value) of a config, section by section."""
    for f in fields(config):
        value = getattr(config, f.name)
        if is_dataclass(value):
            yield from leaves(value, f"{prefix}{f.name}.")
        else:
            yield prefix + f.name, f, value


def lanes_per_task(config: Config) -> int:
    """Parallel environments of each training task."""
    return config.collect.lanes // len(config.tasks.train)
