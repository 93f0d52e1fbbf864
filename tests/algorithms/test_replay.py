"""The rings against a deque of plain Python records, one per lane and task."""

from collections import deque
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmrl_jax.algorithms.common import replay

TASKS, LANES, STEPS, OBS, ACT = 2, 3, 8, 4, 2
CAPACITY = LANES * STEPS
EPISODE = 5
GAMMA = 0.9

sample = jax.jit(replay.sample, static_argnames=("batch", "n_step", "gamma"))
add = jax.jit(replay.add)


def make_steps(start: int, count: int, seed: int = 0) -> replay.Transition:
    """Vector steps `start`.. of lock-step episodes; obs[0] is the time, obs[1] the lane id.

    Lane 0 ends its episodes in a terminal, the others in the time limit.
    """
    rng = np.random.default_rng(seed + start)
    shape = (count, TASKS, LANES)
    time = np.broadcast_to(np.arange(start, start + count)[:, None, None], shape)
    lane = np.broadcast_to(np.arange(LANES), shape)
    obs = rng.normal(size=(*shape, OBS)).astype(np.float32)
    obs[..., 0], obs[..., 1] = time, lane
    obs[..., 2] = np.arange(TASKS)[:, None]
    ends = time % EPISODE == EPISODE - 1
    return replay.Transition(
        obs=jnp.asarray(obs),
        action=jnp.asarray(rng.normal(size=(*shape, ACT)), jnp.float32),
        reward=jnp.asarray(rng.normal(size=shape), jnp.float32),
        terminated=jnp.asarray(ends & (lane == 0)),
        truncated=jnp.asarray(ends & (lane != 0)),
        first=jnp.asarray(time % EPISODE == 0),
        next_obs=jnp.asarray(obs + 0.5),
    )


def fill(chunks: list[int]):
    """A ring fed with these chunk lengths, and the deques it should equal."""
    state = replay.init_replay(TASKS, CAPACITY, LANES, OBS, ACT)
    deques = {(task, lane): deque(maxlen=STEPS) for task in range(TASKS) for lane in range(LANES)}
    start = 0
    for count in chunks:
        steps = make_steps(start, count)
        state = add(state, steps)
        steps = jax.tree.map(np.asarray, steps)
        for time in range(count):
            for (task, lane), records in deques.items():
                leaves = {name: x[time, task, lane] for name, x in vars(steps).items()}
                records.append(replay.Transition(**leaves))
        start += count
    return state, deques


def n_step_by_loop(records: list, position: int, n_step: int):
    """Reward, discount and next_obs of the window that starts at `position` of one lane."""
    reward, weight = 0.0, 1.0
    for record in records[position : position + n_step]:
        reward += weight * float(record.reward)
        weight *= GAMMA
        if record.terminated:
            return reward, 0.0, record.next_obs
        if record.truncated:
            return reward, weight, record.next_obs
        last = record
    return reward, weight, last.next_obs


@pytest.mark.parametrize("chunks", [[3], [8], [3, 3, 3], [5, 1, 6, 7], [2, 19]])
@pytest.mark.parametrize("n_step", [1, 3, 6, 12])
def test_samples_equal_loops_over_a_deque(chunks: list[int], n_step: int):
    state, deques = fill(chunks)
    assert int(state.size) == min(sum(chunks), STEPS) * LANES
    task_ids = jnp.array([1, 0, 1])
    batch = sample(state, jax.random.key(3), task_ids, batch=64, n_step=n_step, gamma=GAMMA)
    for row, task in enumerate(np.asarray(task_ids)):
        for i in range(64):
            obs = np.asarray(batch.obs[row, i])
            records = list(deques[(int(task), int(obs[1]))])
            position = int(obs[0]) - int(records[0].obs[0])
            assert 0 <= position < len(records), "an overwritten or unwritten slot was sampled"
            np.testing.assert_array_equal(obs, records[position].obs)
            np.testing.assert_array_equal(batch.action[row, i], records[position].action)
            reward, discount, next_obs = n_step_by_loop(records, position, n_step)
            np.testing.assert_allclose(batch.reward[row, i], reward, rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(batch.discount[row, i], discount, rtol=1e-6)
            np.testing.assert_array_equal(batch.next_obs[row, i], next_obs)


@pytest.mark.parametrize("sign", ["terminated", "truncated", "first"])
def test_a_window_never_crosses_lanes_or_episodes(sign: str):
    """Trap 19: with reward = lane id any mixture shows; each sign of a border is enough alone."""
    steps = make_steps(0, 11)
    ends = steps.terminated | steps.truncated
    none = jnp.zeros_like(ends)
    signs = {"terminated": none, "truncated": none, "first": none}
    signs[sign] = steps.first if sign == "first" else ends
    steps = replace(steps, reward=steps.obs[..., 1], **signs)
    state = add(replay.init_replay(TASKS, CAPACITY, LANES, OBS, ACT), steps)
    batch = sample(state, jax.random.key(0), jnp.arange(TASKS), batch=256, n_step=3, gamma=1.0)
    time, lane = np.asarray(batch.obs[..., 0]), np.asarray(batch.obs[..., 1])
    length = np.minimum(np.minimum(3, EPISODE - time % EPISODE), 11 - time)
    np.testing.assert_array_equal(batch.reward, lane * length)
    np.testing.assert_array_equal(batch.next_obs[..., 0], time + length - 1 + 0.5)
    np.testing.assert_array_equal(batch.next_obs[..., 1], lane + 0.5)


def test_sampling_covers_the_valid_slots_evenly():
    state, _ = fill([6])
    draws = 60_000
    batch = sample(state, jax.random.key(1), jnp.array([0]), batch=draws, n_step=1, gamma=GAMMA)
    slot = np.asarray(batch.obs[0, :, 0] * LANES + batch.obs[0, :, 1]).astype(int)
    counts = np.bincount(slot, minlength=CAPACITY)
    assert (counts[6 * LANES :] == 0).all()
    expected = draws / (6 * LANES)
    # Five binomial standard deviations: a slot missed or counted twice is off by fifty.
    assert np.abs(counts[: 6 * LANES] - expected).max() < 5 * np.sqrt(expected)


def test_context_samples_are_whole_transitions_of_their_task():
    state = replay.init_context(TASKS, 1, STEPS, LANES, OBS, ACT)
    assert state.rows.shape[1] == CAPACITY
    steps = make_steps(0, 13)
    state = replay.add(state, steps)
    batch = replay.sample_transitions(state, jax.random.key(5), jnp.array([1, 0]), 50)
    time = np.asarray(batch.obs[..., 0]).astype(int)
    lane = np.asarray(batch.obs[..., 1]).astype(int)
    task = np.array([1, 0])[:, None]
    assert time.min() == 13 - STEPS and time.max() == 12
    for name in ("obs", "action", "reward", "next_obs"):
        np.testing.assert_array_equal(
            getattr(batch, name), np.asarray(getattr(steps, name))[time, task, lane]
        )


def test_an_empty_ring_gives_finite_zeros():
    state = replay.init_replay(TASKS, CAPACITY, LANES, OBS, ACT)
    task_ids = jnp.arange(TASKS)
    drawn = (
        sample(state, jax.random.key(0), task_ids, batch=4, n_step=3, gamma=GAMMA),
        replay.sample_transitions(state, jax.random.key(0), task_ids, 4),
    )
    assert int(state.size) == 0
    assert all((np.asarray(leaf) == 0).all() for leaf in jax.tree.leaves(drawn))


def test_add_under_jit_with_donation_keeps_types_and_traces_once():
    traces = []

    def count_and_add(state: replay.ReplayState, steps: replay.Transition):
        traces.append(1)
        return replay.add(state, steps)

    state = replay.init_replay(TASKS, CAPACITY, LANES, OBS, ACT)
    before = jax.eval_shape(lambda: state)
    step = jax.jit(count_and_add, donate_argnums=0)
    for start in (0, 3, 6):
        state = step(state, make_steps(start, 3))
    assert jax.eval_shape(lambda: state) == before
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(state))
    assert len(traces) == 1
    assert int(state.index) == 9 % STEPS * LANES


@pytest.mark.parametrize("capacity, lanes", [(10, 3), (0, 3), (4, 0)])
def test_a_capacity_that_splits_a_step_is_refused(capacity: int, lanes: int):
    with pytest.raises(ValueError, match="multiple"):
        replay.init_replay(TASKS, capacity, lanes, OBS, ACT)


def test_other_lanes_than_the_rings_are_refused():
    state = replay.init_replay(TASKS, 8, 2, OBS, ACT)
    with pytest.raises(ValueError, match="3 lanes"):
        replay.add(state, make_steps(0, 1))
