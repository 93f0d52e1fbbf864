"""What a run is made of, built from its configuration: environment, goals, algorithm.

Shared by training, evaluation and benchmarks.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cmrl_jax import parallel
from cmrl_jax.algorithms.base import Agent, Algorithm, RunState
from cmrl_jax.config.schema import Config, call_envs
from cmrl_jax.evaluation.controls import text_per_goal
from cmrl_jax.evaluation.evaluator import Evaluator, Trial
from cmrl_jax.jax_runtime import (
    cache_directory,
    check_switches,
    first_device,
    jit_once,
    jit_repeated,
)
from cmrl_jax.registry import algorithm, environment, make_algorithm, make_environment, rules_of
from cmrl_jax.storage.checkpoint import policy_store
from cmrl_jax.storage.versions import package_versions
from cmrl_jax.text.goals import GoalTable, load_goals
from envs.base import MetaEnv


def prepare_jax(config: Config) -> str:
    """Applies the `runtime` section, whatever was applied before; returns the device in words.

    An environment that already names a compilation cache (JAX_COMPILATION_CACHE_DIR) keeps it, and
    its own precision (JAX_DEFAULT_MATMUL_PRECISION) is the default one.

    Raises:
        ConfigError: jax is set to what this program cannot work with, or finds no device.
    """
    check_switches()
    default = os.environ.get("JAX_DEFAULT_MATMUL_PRECISION")
    highest = config.runtime.matmul_precision == "highest"
    jax.config.update("jax_default_matmul_precision", "highest" if highest else default)
    cache = config.runtime.compile_cache
    if cache and not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", cache_directory(cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    device = first_device()
    return f"{device.platform} ({device.device_kind}), {jax.device_count()} device(s)"


class TrainingProgram:
    """The two programs of training: its first state, and an iteration, which takes a state's place.

    With several seeds both are of all of them at once. Their states are one then, whose leaves have
    a leading seed axis, but for those that are in step (`Algorithm.in_step`).

    Attributes:
        seeds: how many.
        one: shapes of a single seed's state.
        abstract: shapes of the state, placed on the devices.
        metrics: shapes of a single seed's metrics.
    """

    def __init__(self, algorithm: Algorithm, goals: jax.Array | None, mesh: Any, seeds: int = 1):
        self.seeds = seeds
        init, iteration = algorithm.init, algorithm.make_iteration(goals)
        shapes = jax.eval_shape(init, jax.random.key(0))
        self._axes = None
        self._gradient_steps = algorithm.gradient_steps
        if seeds == 1:
            self.one = self.abstract = parallel.placed(shapes, mesh)
        else:
            axes = jax.tree.map(lambda same: None if same else 0, algorithm.in_step(shapes))
            init = jax.vmap(init, out_axes=axes)
            iteration = jax.vmap(iteration, in_axes=(axes,), out_axes=(axes, 0))
            iteration = parallel.over_seeds(iteration, mesh, axes)
            shapes_of_all = jax.eval_shape(init, jax.random.split(jax.random.key(0), seeds))
            self.one, self._axes = shapes, axes
            count = algorithm.gradient_steps
            self._gradient_steps = jax.vmap(count, in_axes=(axes,), axis_size=seeds)
            self.abstract = parallel.placed_seeds(shapes_of_all, mesh, axes)
            mesh = None  # lanes are not split as well
        places = jax.tree.map(lambda leaf: leaf.sharding, self.abstract)
        # A program of its own, so that every leaf has a buffer: the iteration donates them all.
        self._init = jit_once(init, out_shardings=places)
        self._put = jit_once(self._put_seed, donate_argnums=0, out_shardings=places)
        with parallel.using(mesh):
            # Traced once, for the columns and for the program: tracing the physics takes seconds.
            program = jit_repeated(iteration, donate_argnums=0, out_shardings=(places, None))
            self._traced = program.trace(self.abstract)
        self.metrics = self._traced.out_info[1]
        if seeds > 1:
            first = lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype)
            self.metrics = jax.tree.map(first, self.metrics)
        self._compiled: Any = None

    def init(self, seeds: Sequence[int]) -> RunState:
        """The state of the given seeds before iteration 0."""
        keys = [jax.random.key(seed) for seed in seeds]
        return self._init(keys[0] if self._axes is None else jnp.stack(keys))

    def of_seed(self, state: RunState, index: int) -> RunState:
        """One seed's state, as a run of that seed alone has it."""
        if self._axes is None:
            return state
        take = lambda axis, leaf: leaf if axis is None else leaf[index]
        return jax.tree.map(take, self._axes, state, is_leaf=lambda axis: axis is None)

    def with_seed(self, state: Any, index: int, one: RunState) -> RunState:
        """The state with that of one seed in its place; `state` is donated.

        What is in step is taken from `one`.
        """
        if self._axes is None:
            return one
        return self._put(state, index, one)

    def gradient_steps(self, state: RunState) -> np.ndarray:
        """Gradient steps applied, of each seed."""
        return np.reshape(self._gradient_steps(state), self.seeds)

    def _put_seed(self, state: RunState, index: jax.Array, one: RunState) -> RunState:
        put = lambda axis, leaf, new: new if axis is None else leaf.at[index].set(new)
        return jax.tree.map(put, self._axes, state, one, is_leaf=lambda axis: axis is None)

    @property
    def is_compiled(self) -> bool:
        return self._compiled is not None

    def compile(self) -> Callable[[RunState], tuple[RunState, dict[str, jax.Array]]]:
        """The compiled iteration; later calls do not compile."""
        if self._compiled is None:
            self._compiled = self._traced.lower().compile()
        return self._compiled


class Parts:
    """What a configuration's programs are made of, and the programs themselves.

    Kept from one `Session` to the next where nothing that shapes them differs, so that a process
    that trains or evaluates again does not trace the physics again.
    """

    def __init__(self, config: Config, train_goals: jax.Array):
        self.entries = environment(config.env.name), algorithm(config.algorithm)
        self.env: MetaEnv = call_envs(lambda: make_environment(config.env))
        self.algorithm: Algorithm = call_envs(lambda: make_algorithm(config, self.env, train_goals))
        self.evaluators: OrderedDict[Any, Evaluator] = OrderedDict()
        self.training: dict[Any, Any] = {}


_KEPT = 4  # configurations, and evaluators of each; a program may take some hundred megabytes
_parts: OrderedDict[Any, Parts] = OrderedDict()
_lock = threading.RLock()


def _parts_of(config: Config, goals: GoalTable, train_goals: jax.Array) -> Parts:
    debug = jax.config.jax_debug_nans, jax.config.jax_debug_infs
    key = rules_of(config).shaping(), goals.sha256, debug
    entries = environment(config.env.name), algorithm(config.algorithm)
    with _lock:
        if key not in _parts or any(
            x is not y for x, y in zip(_parts[key].entries, entries, strict=True)
        ):
            _parts[key] = Parts(config, train_goals)
        return _kept(_parts, key)


def _kept(programs: OrderedDict[Any, Any], key: Any) -> Any:
    """The entry of a key, now the last to go; the oldest beyond `_KEPT` are let go."""
    programs.move_to_end(key)
    while len(programs) > _KEPT:
        programs.popitem(last=False)
    return programs[key]


def forget_programs() -> None:
    """Lets go of all that was kept for later sessions: their memory, and code that has changed."""
    with _lock:
        _parts.clear()


class Session:
    """Environment, goal vectors and algorithm of one configuration.

    Attributes:
        eval_tasks: training tasks, then test tasks.
    """

    def __init__(self, config: Config):
        self.config = config
        self.eval_tasks = config.tasks.train + config.tasks.test
        self.goals: GoalTable = load_goals(config.goals.table, self.eval_tasks)
        self.train_goals = jnp.asarray(self.goals.select(config.tasks.train).vectors)
        self._parts = _parts_of(config, self.goals, self.train_goals)
        self.env, self.algorithm = self._parts.env, self._parts.algorithm

    @property
    def agent(self) -> Agent:
        return self.algorithm.agent

    def agent_of(self, adapt: str) -> Agent:
        """The agent of a name that `AlgorithmRules.ways` has, else the default one."""
        return self.algorithm.agents.get(adapt, self.algorithm.agent)

    def placements(
        self, goal_set: str, goals: int, tasks: Sequence[str] | None = None
    ) -> np.ndarray:
        """The first `goals` goals of a named set (task, goal, goal_size), by default for all."""
        return call_envs(lambda: self.env.goals(goal_set, tasks or self.eval_tasks))[:, :goals]

    def train_placements(self) -> jax.Array | None:
        """Goals that training draws from; None where it draws by the environment's resets."""
        if self.config.env.variation == "episode_random":
            return None
        train = call_envs(lambda: self.env.goals("train", self.config.tasks.train))
        return jnp.asarray(train, jnp.float32)

    def trial(self, goal_set: str, goals: int) -> Trial:
        """The protocol's own trial: every evaluated task, its first sentence, one draw a goal."""
        texts = text_per_goal(list(self.goals.vectors[:, :1]), goals)
        return Trial(self.eval_tasks, self.placements(goal_set, goals), texts[None])

    def evaluator(
        self,
        lanes: int | None = None,
        horizon: int | None = None,
        policies: int = 1,
        adapt: str = "posterior",
    ) -> Evaluator:
        """An evaluator; with a program that an earlier one of its kind has compiled.

        Args:
            lanes: of a batch; by default those of a periodic evaluation of training.
            horizon: control steps an episode; the run's own by default.
            policies: scored side by side.
            adapt: see `EvalOptions`.
        """
        lanes = lanes or self.config.eval.goals * len(self.eval_tasks)
        kind = lanes, horizon or self.config.env.horizon, policies, adapt
        agent = self.agent_of(adapt)
        kept = self._parts.evaluators
        with _lock:
            if kind not in kept:
                kept[kind] = Evaluator(self.config, self.env, agent, lanes, horizon, policies)
            return _kept(kept, kind)

    def forget(self, evaluator: Evaluator) -> None:
        """Lets an evaluator go that is not to be used again."""
        with _lock:
            for kind in [k for k, kept in self._parts.evaluators.items() if kept is evaluator]:
                del self._parts.evaluators[kind]

    def training(self, mesh: Any, seeds: int = 1) -> TrainingProgram:
        """The training iteration over a mesh of devices, traced and not yet compiled.

        Args:
            seeds: runs that it trains at once.
        """
        kept, kind = self._parts.training, (mesh, seeds)
        if kind not in kept:
            goals = self.train_placements()
            kept[kind] = TrainingProgram(self.algorithm, goals, mesh, seeds)
        return kept[kind]


@dataclass(frozen=True)
class Policy:
    """A policy checkpoint.

    Attributes:
        params: what acts.
        goal_vectors: the text vectors that the run evaluates with, {task: (G,)}.
        meta: the checkpoint's record (`checkpoint.META_FIELDS`).
    """

    params: Any
    goal_vectors: dict[str, np.ndarray]
    meta: dict[str, Any]


def load_policy(
    run: Path, session: Session, checkpoint: int | None = None, tasks: Sequence[str] | None = None
) -> Policy:
    """Reads a policy checkpoint of a run.

    Args:
        session: of the run's configuration, or of one with the same policy.
        checkpoint: iteration; None for the newest.
        tasks: the run's training, then test tasks, where the session's are others.

    Raises:
        ConfigError: no such checkpoint, or it does not fit the session.
    """
    tasks = tuple(tasks or session.eval_tasks)
    act = session.algorithm.policy_params
    params = jax.eval_shape(lambda key: act(session.algorithm.init(key)), jax.random.key(0))
    shape = (len(tasks), session.goals.vectors.shape[-1])
    vectors = jax.ShapeDtypeStruct(shape, np.float32)
    abstract = {"params": params, "goal_vectors": vectors}
    with policy_store(run, read_only=True) as store:
        trees, meta = store.restore(
            {"policy": abstract}, step=checkpoint, versions=package_versions()
        )
    found = np.asarray(trees["policy"]["goal_vectors"])
    return Policy(trees["policy"]["params"], dict(zip(tasks, found, strict=True)), meta)
