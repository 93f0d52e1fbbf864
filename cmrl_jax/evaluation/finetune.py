"""Fine-tuning on a task that was held out: success against the policy's own experience there.

One lane gathers episode after episode of the task, on goals of its own; gradient steps change what
`adapt` allows, as many in the first episode as in every later one, so that after k episodes the
ways that learn have made equally many. At the read-outs the policy is scored on a named goal set: z
from the belief over all own transitions, no further adaptation. Normalisers stay those of training,
and rewards are divided by the mean of the training tasks' denominators;
`scratch` is SAC that knows nothing: its first episode has random actions, and it keeps statistics
of its own. `search` spends its first episodes as `eval --adapt search` does, without gradients, and
goes on from the winner: its z is a parameter, and the task is seen as its arm sees it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax.algorithms.base import Told
from cmrl_jax.algorithms.cmrl.agent import CmrlAgent, make_policy_params
from cmrl_jax.algorithms.cmrl.collect import TrainIteration, init_run
from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.cmrl.train_state import PACKED, TrainState, pack, unpack
from cmrl_jax.algorithms.common.replay import ReplayState, stored_transitions
from cmrl_jax.config.files import load_config
from cmrl_jax.config.rules import validate
from cmrl_jax.config.schema import Config
from cmrl_jax.evaluation.episode import Episode, Lanes, make_episode
from cmrl_jax.evaluation.finetune_options import FREE_Z, PARTIAL, FinetuneOptions
from cmrl_jax.jax_runtime import jit_once, jit_repeated
from cmrl_jax.nn import normalizers
from cmrl_jax.nn.context import Belief, ContextInference, init_belief, make_context_inference
from cmrl_jax.nn.distributions import Gaussian
from cmrl_jax.nn.optimizers import init_adam
from cmrl_jax.registry import make_environment
from envs.turned import TurnedEnv

ROUTER_PARTS = ("embedding", "gating", "routing")  # names in networks.SoftModularNet begin so
FREE_LATENT = "z"


class Score(NamedTuple):
    """A read-out: means over its goals, and what went wrong until then.

    Attributes:
        faults: times a lane's physics was put back, mean over goals.
        own_faults: times it was put back in the own episodes so far.
        skipped: gradient steps so far that were dropped for a non-finite gradient.
    """

    success_any: float
    success_last: float
    returns: float
    faults: float
    own_faults: int = 0
    skipped: int = 0


class Winner(NamedTuple):
    """What a search has found: z (latent,), and the arm's matrices of observation and action."""

    z: jax.Array
    of_obs: np.ndarray
    of_action: np.ndarray


def finetune_config(
    config: Config, task: str, adapt: str, episodes: int, updates: int, denominator: float
) -> Config:
    """The configuration of one lane on one task.

    Args:
        config: the run's own.
        adapt: see `finetune_options.ADAPT`.
        updates: gradient steps per control step.
        denominator: what rewards are divided by.

    Raises:
        ConfigError: a combination that `validate` refuses.
    """
    # Also from scratch: every way sees the observations of the run, in episodes and chunks as its.
    env, chunk = config.env, config.collect.chunk
    if adapt == "scratch":
        batch = config.sac.batch
        config = load_config("sac.yaml")
        sac = replace(config.sac, batch=batch, n_step=min(config.sac.n_step, env.horizon))
    else:
        scale = config.sac.reward_scale / denominator
        sac = replace(config.sac, reward_norm="none", reward_scale=scale, task_rows=0)
    sac = replace(sac, policy_average=0.0)  # read-outs act by what the last episode taught
    encoder = config.encoder
    if encoder.aux == "contrastive":
        encoder = replace(encoder, aux="none")  # one task alone has nothing to be told from
    if adapt in FREE_Z:
        # The latent stands alone: no encoder, and no decoder that its parameters would hold.
        encoder = replace(encoder, information_bottleneck=False, aux="none")
    collect = replace(
        config.collect,
        lanes=1,
        chunk=chunk,
        group_frac=(0.0, 0.0, 1.0),
        updates_per_vector_step=updates,
        scatter=0,
        initial="random" if adapt == "scratch" else "prior",
        context_source="recent",
        context_episodes=episodes,
        context_lanes="all",
    )
    tuned = replace(
        config,
        env=env,
        sac=sac,
        encoder=encoder,
        collect=collect,
        tasks=replace(config.tasks, train=(task,), test=()),
        train=replace(config.train, capacity=max(episodes * env.horizon, sac.batch)),
    )
    validate(tuned)
    return tuned


def free_latent(latent_dim: int) -> ContextInference:
    """Inference whose posterior is one point, the parameter `z` (latent,), whatever was seen."""

    def point(params: Any, lead: tuple[int, ...]) -> Gaussian:
        mean = jnp.broadcast_to(params[FREE_LATENT], (*lead, latent_dim))
        return Gaussian(mean, jnp.ones_like(mean))

    return ContextInference(
        latent_dim=latent_dim,
        has_goal_factor=False,
        posterior=lambda params, transitions, mask, goal=None, goal_mask=None: point(
            params, mask.shape[:-1]
        ),
        update_belief=lambda params, belief, transitions, mask, goal=None, goal_mask=None: belief,
        posterior_of_belief=lambda params, belief, goal=None, goal_mask=None: point(
            params, belief.sums.count.shape
        ),
        z_of_noise=lambda gaussian, noise: gaussian.mean,
        sample_z=lambda key, gaussian: gaussian.mean,
    )


def is_adapted(adapt: str, network: str, path: tuple[Any, ...]) -> bool:
    """Whether gradient steps of a way in `PARTIAL` change a leaf of one of `PACKED`."""
    if adapt == "z":
        return network == "encoder_params"
    names = [str(getattr(key, "key", "")) for key in path]
    is_router = any(name.startswith(ROUTER_PARTS) for name in names)
    return is_router and network != "encoder_params"


class RestrictedLearner(Learner):
    """A learner whose gradient steps change only what `adapt` allows; other arguments as its."""

    def __init__(self, adapt: str, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self.adapt = adapt

    def step(
        self,
        flat: TrainState,
        like: TrainState,
        replay_state: Any,
        context_state: Any,
        key: jax.Array,
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        """One gradient step; what it must not change is put back."""
        adapt = self.adapt
        if adapt == "posterior":
            return flat, {}
        new, metrics = super().step(flat, like, replay_state, context_state, key)
        if adapt not in PARTIAL:
            return new, metrics
        moved, before = unpack(new, like), unpack(flat, like)
        kept = {
            name: jax.tree_util.tree_map_with_path(
                lambda path, new, old, name=name: new if is_adapted(adapt, name, path) else old,
                getattr(moved, name),
                getattr(before, name),
            )
            for name in PACKED
        }
        return pack(replace(moved, **kept)), metrics


def start_state(
    adapt: str,
    config: Config,
    learner: Learner,
    fresh: TrainState,
    trained: TrainState,
    text: jax.Array,
    z: jax.Array | None = None,
) -> TrainState:
    """A learner's first state, with what was trained in its place.

    Args:
        fresh: a first state of `learner`.
        trained: the run's state, of any number of tasks.
        text: text vector of the new task (G,).
        z: where a free latent begins (latent,); None: where the sentence alone puts it, or at the
            prior's mean.
    """
    if adapt == "scratch":
        return jax.tree.map(jnp.copy, fresh)  # every leaf a buffer of its own, to be donated
    kept = {name: getattr(trained, name) for name in PACKED}
    kept["actor_params"], kept["encoder_params"] = trained.acting
    if adapt in FREE_Z:
        if z is None:
            bottleneck = replace(config.encoder, information_bottleneck=True)
            original = make_context_inference(replace(config, encoder=bottleneck), learner.networks)
            belief, told = init_belief((), original.latent_dim), jnp.ones(())
            z = original.posterior_of_belief(kept["encoder_params"], belief, text, told).mean
        kept["encoder_params"] = {FREE_LATENT: z}
        fresh = replace(fresh, encoder_opt_state=init_adam(kept["encoder_params"]))
    state = replace(
        fresh,
        **kept,
        log_alpha=jnp.full_like(fresh.log_alpha, jnp.mean(trained.log_alpha)),
        obs_stats=trained.obs_stats,
    )
    return jax.tree.map(jnp.copy, state)  # it is donated, the trained one is used again


class FineTuning:
    """One way to adapt on one task: its programs, and the run from episode to episode.

    Args:
        config: of `finetune_config`, for the way and its task.
        adapt: one of `finetune_options.ADAPT`.
        text: text vector of the task (G,).
        winner: of the search that came before, for the way `search`.
    """

    def __init__(
        self,
        config: Config,
        adapt: str,
        trained: TrainState,
        text: np.ndarray,
        options: FinetuneOptions,
        winner: Winner | None = None,
    ):
        self.config = config
        physics = options.physics or self.config.env.physics
        self.env = make_environment(replace(self.config.env, physics=physics))
        if winner is not None:
            self.env = TurnedEnv(self.env, winner.of_obs, winner.of_action)
        goals = jnp.asarray(text)[None, None]  # (task, paraphrase, G)
        inference = None
        if adapt in FREE_Z:
            inference = free_latent(self.config.encoder.latent_dim)
        sizes = self.env.observation_size, self.env.action_size
        self.learner = RestrictedLearner(adapt, self.config, goals, *sizes, inference=inference)
        learner = self.learner
        self.agent = CmrlAgent(learner, self.config.collect.chunk)
        self.policy_params = make_policy_params(learner)
        self.text, self.task = text, options.task
        iteration = TrainIteration(
            self.config,
            self.env,
            self.learner,
            goals,
            None,
            freeze_statistics=adapt != "scratch",
            learn_at_once=True,
        )
        self.iteration = jit_repeated(iteration, donate_argnums=0)
        self.episode = jit_repeated(make_episode(self.env, self.agent, self.config.env.horizon))
        # As programs: op by op, each of their hundreds of shapes would be compiled by itself.
        init = jit_once(lambda key: init_run(self.config, self.env, learner, key))
        start = jit_once(
            lambda fresh, trained, text: start_state(
                adapt, self.config, learner, fresh, trained, text, winner.z if winner else None
            )
        )
        self.own_belief = jax.jit(
            lambda state, ring, text: own_belief(self.learner, state, ring, text)
        )
        run = init(jax.random.key(options.seed))
        self.run = run.replace(learner=start(run.learner, trained, jnp.asarray(text)))
        self.own_faults = 0

    def gather(self) -> None:
        """One own episode, with its gradient steps."""
        self.run, metrics = self.iteration(self.run)
        self.own_faults += int(metrics["physics_faults"])

    def read_out(self, placements: np.ndarray, seed: int) -> Score:
        """Success on goals (goal, goal_size), with the belief over all own transitions."""
        goals, state = len(placements), self.run.learner
        texts = np.broadcast_to(self.text, (1, goals, len(self.text)))
        row, task = np.zeros(goals, np.int32), self.env.tasks.index(self.task)
        told = Told(texts, np.ones((1, goals), np.float32), row[None])
        memory = self.agent.init(told)
        if self.learner.inference is not None:
            own = self.own_belief(state, self.run.context, jnp.asarray(self.text))
            belief = jax.tree.map(lambda x: jnp.broadcast_to(x, (1, goals, *x.shape[1:])), own)
            memory = replace(memory, belief=belief)
        _, scores = self.episode(
            jax.tree.map(lambda x: x[None], self.policy_params(self.run)),  # one policy
            memory,
            memory,
            Lanes(row + task, np.arange(goals, dtype=np.int32), placements),
            np.bool_(True),
            np.bool_(True),
            jax.random.key(seed),
        )
        skipped = int(state.skipped_updates)
        return mean_score(scores)._replace(own_faults=self.own_faults, skipped=skipped)


def mean_score(scores: Episode) -> Score:
    """Means over all lanes."""
    mean = lambda figure: float(np.mean(figure))
    return Score(
        success_any=mean(scores.success_any),
        success_last=mean(scores.success_last),
        returns=mean(scores.returns),
        faults=mean(scores.faults),
    )


def own_belief(learner: Learner, state: TrainState, ring: ReplayState, text: jax.Array) -> Belief:
    """The belief over every transition of a ring of one task, leading axis 1."""
    inference = learner.inference
    assert inference is not None
    seen, mask = stored_transitions(ring)
    seen = learner.normalized(state.obs_stats, seen)
    empty = init_belief((1,), inference.latent_dim)
    return inference.update_belief(
        state.encoder_params, empty, seen, mask, text[None], jnp.ones((1,))
    )


def adaptation_curve(
    tuning: FineTuning,
    options: FinetuneOptions,
    placements: np.ndarray,
    say: Callable[[int, Score], None],
    searched: int | None = None,
) -> None:
    """Gathers and learns, episode after episode; says the score at each read-out.

    Args:
        searched: own episodes that a search has spent and has said the scores of.
    """
    if searched is None and 0 in options.read_outs:
        say(0, tuning.read_out(placements, options.seed))
    for episode in range(1 + (searched or 0), options.episodes + 1):
        tuning.gather()
        if episode in options.read_outs:
            say(episode, tuning.read_out(placements, options.seed))


def training_denominator(config: Config, state: TrainState) -> float:
    """Mean of the training tasks' reward denominators: no statistic of the new task is used."""
    return float(np.mean(normalizers.reward_denominator(state.return_stats, config.sac)))
