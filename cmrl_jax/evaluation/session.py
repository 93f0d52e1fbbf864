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

    Attributes:
        abstract: shapes of the state, placed on the devices.
        init: key -> RunState.
        metrics: shapes of an iteration's metrics.
    """

    def __init__(self, algorithm: Algorithm, goals: jax.Array | None, mesh: Any):
        shapes = jax.eval_shape(algorithm.init, jax.random.key(0))
        self.abstract = parallel.placed(shapes, mesh)
        places = jax.tree.map(lambda leaf: leaf.sharding, self.abstract)
        # A program of its own, so that every leaf has a buffer: the iteration donates them all.
        self.init = jit_once(algorithm.init, out_shardings=places)
        iteration = algorithm.make_iteration(goals)
        with parallel.using(mesh):
            # Traced once, for the columns and for the program: tracing the physics takes seconds.
            program = jit_repeated(iteration, donate_argnums=0, out_shardings=(places, None))
            self._traced = program.trace(self.abstract)
        self.metrics = self._traced.out_info[1]
        self._compiled: Any = None

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

    def training(self, mesh: Any) -> TrainingProgram:
        """The training iteration over a mesh of devices, traced and not yet compiled."""
        kept = self._parts.training
        if mesh not in kept:
            kept[mesh] = TrainingProgram(self.algorithm, self.train_placements(), mesh)
        return kept[mesh]


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
