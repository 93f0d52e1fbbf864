"""What an algorithm is to the rest of the program: `Algorithm` trains, `Agent` acts.

Training, evaluation, films and Meta-World's evaluator use these alone; an algorithm's own parts
stay in its folder.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import jax
from flax import struct


class Told(NamedTuple):
    """What lanes are told of their task, numpy or jax arrays with any leading axes.

    Attributes:
        text: text vector (..., G).
        text_mask: (...) float32, 0 where the text is withheld.
        task_row: (...) int32, the task's row among the training tasks; read by policies that are
            told which task it is.
    """

    text: Any
    text_mask: Any
    task_row: Any


class Agent(Protocol):
    """A policy that may learn from its own episodes: pure, batched over lanes, parameters apart.

    `memory` is the agent's own pytree with a leading lane axis, what a lane has seen and been told:
    a belief over z, a hidden state, the state of a search.

    It may have `describe(memory) -> list[str]`, too: in a few words for each lane, what its episode
    is acted on, which films show.

    Attributes:
        adapts: whether experience changes what it does.
        explores: whether an episode that it learns from differs from one that counts.
        chunk: control steps that may pass between two calls of `observe`; 1 where it acts on what
            it has just seen. Meta-World's own evaluation shows all others a whole episode at once.
    """

    @property
    def adapts(self) -> bool: ...

    @property
    def explores(self) -> bool: ...

    @property
    def chunk(self) -> int: ...

    def init(self, told: Told) -> Any:
        """The memory of lanes that have seen nothing; `told` with any leading axes."""
        ...

    def begin_episode(
        self, params: Any, memory: Any, source: Any, keys: jax.Array, exploit: jax.Array
    ) -> Any:
        """The memory for an episode that begins.

        Args:
            source: the memory that the episode is acted on; each lane's own, but in an
                evaluation's controls, which give it another's or one without experience.
            keys: (lane,) keys of what the agent draws for an episode.
            exploit: () bool, whether the episode counts: it is to go well, and is not learned from.
        """
        ...

    def act(
        self, params: Any, memory: Any, obs: jax.Array, noise: jax.Array, deterministic: Any
    ) -> jax.Array:
        """Actions (lane, act) in [-1, 1].

        Args:
            obs: (lane, obs), as the environment shows them.
            noise: (lane, act) standard normal.
            deterministic: whether the noise is left out.
        """
        ...

    def observe(self, params: Any, memory: Any, transitions: Any, mask: jax.Array) -> Any:
        """The memory with transitions (lane, time, ...) added, oldest first, where the mask is 1.

        Args:
            transitions: `common.replay.Transition`, observations as the environment shows them.
            mask: (lane, time) float32.
        """
        ...


class RunState(struct.PyTreeNode):
    """Everything that flows from one training iteration to the next, and is saved.

    Attributes:
        learner: parameters, optimizer states, statistics.
        replay, context: buffers; an empty tuple where the algorithm has none.
        key: of the draws to come.
        iteration: () int32, iterations done.
    """

    learner: Any
    replay: Any
    context: Any
    key: jax.Array
    iteration: jax.Array


def iteration_alone(run: RunState) -> RunState:
    """`Algorithm.in_step` of a state that counts nothing else."""
    return jax.tree.map(lambda _: False, run).replace(iteration=True)


TrainIteration = Callable[[RunState], tuple[RunState, dict[str, jax.Array]]]


@dataclass(frozen=True)
class Algorithm:
    """Pure functions of one configuration.

    Attributes:
        agents: what acts, by what own episodes change (`AlgorithmRules.ways`); the first is the
            default.
        init: key -> RunState before iteration 0.
        make_iteration: goals (training task, goal, goal_size) that episodes begin with, or None for
            the environment's own resets -> one jittable training iteration, RunState -> RunState,
            metrics. Metrics are float32, () or one value a training task (task,). Read by name
            are `success_any` and `return` (for lines and plots), `physics_faults` and `skipped`
            (steps put back, share of gradients dropped: a run that has too many stops).
        policy_params: RunState -> the parameters that the agent acts with, saved as a policy.
        gradient_steps: RunState -> () int32, gradient steps applied.
        in_step: RunState -> bool for every leaf: whether it depends on the number of iterations
            alone, as counters and ring positions do. Seeds in one program share such a leaf.
        parts: the algorithm's own, for what inspects or fine-tunes it.
    """

    agents: Mapping[str, Agent]
    init: Callable[[jax.Array], RunState]
    make_iteration: Callable[[jax.Array | None], TrainIteration]
    policy_params: Callable[[RunState], Any]
    gradient_steps: Callable[[RunState], jax.Array]
    in_step: Callable[[RunState], RunState] = iteration_alone
    parts: Any = None

    @property
    def agent(self) -> Agent:
        """The default agent."""
        return next(iter(self.agents.values()))
