"""Replay and context rings: per-task ring buffers as pytrees on the device, with pure functions.

All tasks share one write pointer and fill equally. A ring holds whole vector steps in time order,
slot = (time * lanes + lane) mod capacity, so the same lane's next step is `slot + lanes`; that is
all that n-step targets need. A transition is one packed row, because a batch then costs three
gathers instead of ten (measured: 107 us against 194 us for 3 x 128 transitions, n = 3, 2 cores).
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from cmrl_jax import parallel


@struct.dataclass
class Transition:
    """Steps of the environment, any leading axes.

    Attributes:
        obs: (..., obs) observation before the action.
        action: (..., act) action in [-1, 1].
        reward: (...) raw reward of the step.
        terminated: (...) bool, the episode ended in a true terminal.
        truncated: (...) bool, the episode hit its time limit.
        first: (...) bool, first step of an episode.
        next_obs: (..., obs) observation after the action, before any reset.
    """

    obs: jax.Array
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    first: jax.Array
    next_obs: jax.Array


@struct.dataclass
class ReplayState:
    """A ring of transitions for every task.

    Attributes:
        rows: (task, capacity, width) float32; columns obs, action, reward, terminated, truncated,
            first, next_obs.
        index: () int32, slot of the next write, the same for all tasks.
        size: () int32, valid slots of each task; 0 means empty.
        lanes_per_task: lanes that write, the distance between a lane's successive steps.
        obs_size: width of an observation.
        action_size: width of an action.
    """

    rows: jax.Array
    index: jax.Array
    size: jax.Array
    lanes_per_task: int = struct.field(pytree_node=False)
    obs_size: int = struct.field(pytree_node=False)
    action_size: int = struct.field(pytree_node=False)


@struct.dataclass
class Batch:
    """Transitions for the Bellman update: obs, next_obs (row, batch, obs), action (row, batch,
    act), reward and discount (row, batch). The target is `reward + discount * V(next_obs)`."""

    obs: jax.Array
    action: jax.Array
    reward: jax.Array
    discount: jax.Array
    next_obs: jax.Array


@struct.dataclass
class ContextBatch:
    """Transitions for the context encoder: obs, next_obs (row, n, obs), action (row, n, act),
    reward (row, n), raw."""

    obs: jax.Array
    action: jax.Array
    reward: jax.Array
    next_obs: jax.Array


def init_replay(
    num_tasks: int, capacity: int, lanes_per_task: int, obs_size: int, action_size: int
) -> ReplayState:
    """An empty ring of `capacity` transitions per task.

    Raises:
        ValueError: the capacity is not a positive multiple of the lanes of a task.
    """
    if lanes_per_task < 1 or capacity < 1 or capacity % lanes_per_task:
        raise ValueError(
            f"capacity {capacity} is not a positive multiple of {lanes_per_task} lanes per task"
        )
    return ReplayState(
        rows=jnp.zeros((num_tasks, capacity, 2 * obs_size + action_size + 4), jnp.float32),
        index=jnp.zeros((), jnp.int32),
        size=jnp.zeros((), jnp.int32),
        lanes_per_task=lanes_per_task,
        obs_size=obs_size,
        action_size=action_size,
    )


def init_context(
    num_tasks: int,
    episodes: int,
    horizon: int,
    lanes_per_task: int,
    obs_size: int,
    action_size: int,
) -> ReplayState:
    """An empty ring for the last `episodes` episodes (of `horizon` steps) of the eligible lanes.

    Raises:
        ValueError: no episode or no lane would fit.
    """
    window = episodes * horizon * lanes_per_task
    return init_replay(num_tasks, window, lanes_per_task, obs_size, action_size)


def add(state: ReplayState, transitions: Transition) -> ReplayState:
    """Append vector steps, overwriting the oldest.

    Args:
        state: the ring; donate it, the write is in place.
        transitions: leaves (time, task, lane, ...), any number of steps.

    Raises:
        ValueError: the number of lanes is not the ring's (found while tracing).
    """
    lanes, capacity = transitions.reward.shape[2], state.rows.shape[1]
    if lanes != state.lanes_per_task:
        raise ValueError(f"got {lanes} lanes per task, the ring holds {state.lanes_per_task}")
    columns = (
        transitions.obs,
        transitions.action,
        transitions.reward[..., None],
        transitions.terminated[..., None],
        transitions.truncated[..., None],
        transitions.first[..., None],
        transitions.next_obs,
    )
    rows = jnp.concatenate([c.astype(jnp.float32) for c in columns], -1)  # (time, task, lane, w)

    # One write a step: capacity is a multiple of the lanes, so a step never straddles the end,
    # whatever the chunk's length, and every write is an in-place dynamic_update_slice.
    def write_step(time: jax.Array, carry: tuple[jax.Array, jax.Array]):
        ring, index = carry
        ring = jax.lax.dynamic_update_slice(ring, rows[time], (0, index, 0))
        return ring, (index + lanes) % capacity

    num_steps = rows.shape[0]
    if parallel.is_split():  # by slot: a scatter lets every device write its own, a slice does not
        slots = (state.index + jnp.arange(num_steps * lanes)) % capacity
        by_slot = jnp.swapaxes(rows, 0, 1).reshape(rows.shape[1], -1, rows.shape[-1])
        ring = parallel.split(state.rows.at[:, slots].set(by_slot, unique_indices=True), axis=1)
        index = (state.index + num_steps * lanes) % capacity
    else:
        ring, index = jax.lax.fori_loop(0, num_steps, write_step, (state.rows, state.index))
    size = jnp.minimum(state.size + num_steps * lanes, capacity)
    return replace(state, rows=ring, index=index, size=size)


def sample(
    state: ReplayState, key: jax.Array, task_ids: jax.Array, batch: int, n_step: int, gamma: float
) -> Batch:
    """Draw `batch` transitions per task row, uniformly with replacement, with n-step returns.

    From step t, m <= n_step steps of the same lane count: reward = sum_{j<m} gamma^j r_{t+j},
    next_obs is that of the m-th step, discount = gamma^m (1 - terminated). A window stops at the
    end of its episode and at the write head. An empty ring gives zeros.

    Args:
        state: the replay ring.
        key: a typed key.
        task_ids: (row,) int, which task each row is drawn from; repeats are fine.
        batch: transitions per row.
        n_step: longest window in control steps, at least 1.
        gamma: discount of a control step.
    """
    rows, lanes, capacity = state.rows, state.lanes_per_task, state.rows.shape[1]
    task, slots = _draw(state, key, task_ids, batch)  # (row, 1), (row, batch)

    steps = np.arange(n_step)
    window = (slots[..., None] + steps * lanes) % capacity  # (row, batch, time)
    scalars = slice(state.obs_size + state.action_size, state.obs_size + state.action_size + 4)
    reward, terminated, truncated, first = jnp.moveaxis(
        rows[task[..., None], window, scalars], -1, 0
    )

    newer = (state.index // lanes - 1 - slots // lanes) % (capacity // lanes)  # (row, batch)
    ended = (terminated + truncated) > 0
    joins = (newer[..., None] >= steps[1:]) & ~ended[..., :-1] & (first[..., 1:] == 0)
    joins = jnp.concatenate([jnp.ones_like(ended[..., :1]), joins], -1)
    used = jnp.cumprod(joins, -1)  # (row, batch, time), 1 until the window is cut
    length = used.sum(-1)

    powers = jnp.asarray(gamma ** np.arange(n_step + 1), jnp.float32)
    last = (length - 1)[..., None]
    last_slot = jnp.take_along_axis(window, last, -1)[..., 0]
    is_terminal = jnp.take_along_axis(terminated, last, -1)[..., 0]
    start_rows = rows[task, slots, : scalars.start]
    return Batch(
        obs=start_rows[..., : state.obs_size],
        action=start_rows[..., state.obs_size :],
        reward=jnp.sum(powers[:-1] * used * reward, -1),
        discount=jnp.where(state.size > 0, powers[length] * (1.0 - is_terminal), 0.0),
        next_obs=rows[task, last_slot, scalars.stop :],
    )


def sample_transitions(
    state: ReplayState, key: jax.Array, task_ids: jax.Array, n: int
) -> ContextBatch:
    """Draw `n` single transitions per task row, uniformly with replacement.

    Args:
        state: the context ring, or the replay ring for `context_source: all`.
        key: a typed key.
        task_ids: (row,) int.
        n: transitions per row. An empty ring gives zeros; ask `state.size`.
    """
    task, slots = _draw(state, key, task_ids, n)
    return _context_batch(state, state.rows[task, slots])


def stored_transitions(state: ReplayState) -> tuple[ContextBatch, jax.Array]:
    """Every slot of a ring as transitions (task, capacity, ...), and which are filled, 1 or 0."""
    slots = jnp.arange(state.rows.shape[1])
    mask = jnp.broadcast_to(slots < state.size, state.rows.shape[:2])
    return _context_batch(state, state.rows), mask.astype(jnp.float32)


def _context_batch(state: ReplayState, rows: jax.Array) -> ContextBatch:
    end_of_obs, end_of_action = state.obs_size, state.obs_size + state.action_size
    return ContextBatch(
        obs=rows[..., :end_of_obs],
        action=rows[..., end_of_obs:end_of_action],
        reward=rows[..., end_of_action],
        next_obs=rows[..., end_of_action + 4 :],
    )


def _draw(
    state: ReplayState, key: jax.Array, task_ids: jax.Array, count: int
) -> tuple[jax.Array, jax.Array]:
    """Task index (row, 1) and uniform valid slots (row, count)."""
    limit = jnp.maximum(state.size, 1)  # an empty ring is drawn from slot 0, which holds zeros
    # One call of the generator where `randint` makes three. What the remainder of 32 bits favours
    # the lower slots by is limit / 2^32, less than one in ten thousand for 400,000 slots.
    bits = jax.random.bits(key, (task_ids.shape[0], count), jnp.uint32)
    return task_ids[:, None], (bits % limit.astype(jnp.uint32)).astype(jnp.int32)
