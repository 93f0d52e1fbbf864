"""The brax view: fresh episodes at the time limit, the terminal observation kept, clean types."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.physics.mjx.backend import MjxPhysics
from envs.tasks import METAWORLD_TASKS as TASKS

HORIZON, LANES, STEPS = 3, 4, 8


@pytest.fixture(scope="module")
def no_physics():
    """The view's own logic needs no simulation: the hand drifts by the action, nothing else."""

    def drift(self, state, action, scene_id):
        return state.replace(qpos=state.qpos.at[0].add(0.01 * action[0])), jnp.ones((), bool)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MjxPhysics, "advance", drift)
        yield


def episodes(env):
    """Start states and `STEPS` scanned steps of vmapped lanes: leaves (step, lane, ...)."""

    def run(keys):
        start = jax.vmap(env.reset)(keys)
        actions = jnp.full((LANES, env.action_size), 0.5)
        step = lambda state, _: (jax.vmap(env.step)(state, actions),) * 2
        return start, jax.lax.scan(step, start, None, length=STEPS)[1]

    return jax.jit(run)(jax.random.split(jax.random.key(1), LANES))


def test_auto_reset_starts_a_fresh_episode_with_another_goal(no_physics):
    env = envs.make("window-open", horizon=HORIZON)
    from brax.envs.base import Env  # quietly imported by now

    assert isinstance(env, Env) and env.backend == "mjx" and env.dt == pytest.approx(0.0125)
    assert (env.observation_size, env.action_size) == (39, 4)
    start, states = episodes(env)
    ends = np.arange(1, STEPS + 1) % HORIZON == 0
    np.testing.assert_array_equal(states.done, np.tile(ends[:, None], (1, LANES)))
    np.testing.assert_array_equal(states.info["truncation"], states.done)

    inner = states.pipeline_state
    np.testing.assert_array_equal(inner.steps[:, 0], [1, 2, 0, 1, 2, 0, 1, 2])
    np.testing.assert_array_equal(states.obs, inner.obs)
    begun = np.concatenate([start.pipeline_state.physics.placement, *inner.physics.placement[ends]])
    assert len(np.unique(begun, axis=0)) == LANES * 3  # every episode of every lane has its own
    # The end of an episode shows its own handle; the state already shows that of the next one.
    before = np.asarray(states.obs[np.flatnonzero(ends) - 1])
    last, next_start = np.asarray(states.info["last_obs"])[ends], np.asarray(states.obs)[ends]
    np.testing.assert_allclose(last[..., 4:7], before[..., 4:7], atol=1e-6)
    np.testing.assert_array_equal(last[..., 18:36], before[..., :18])
    assert np.abs(next_start[..., 4:7] - last[..., 4:7]).max(-1).min() > 1e-4
    # Within an episode the last observation is the observation.
    running = ~ends
    np.testing.assert_array_equal(states.info["last_obs"][running], states.obs[running])


@pytest.mark.slow
def test_without_auto_reset_the_last_state_stays(no_physics):
    env = envs.make("drawer-close", horizon=HORIZON, auto_reset=False, goal_observable=True)
    start, states = episodes(env)
    np.testing.assert_array_equal(states.pipeline_state.steps[:, 0], np.arange(1, STEPS + 1))
    np.testing.assert_array_equal(states.done[:, 0], np.arange(1, STEPS + 1) >= HORIZON)
    places = np.asarray(states.pipeline_state.physics.placement)
    np.testing.assert_array_equal(places, np.broadcast_to(places[:1], places.shape))
    assert np.abs(np.asarray(states.obs)[..., 36:]).max(-1).min() > 0.1  # the goal is shown
    assert len(np.unique(np.asarray(start.obs)[:, 36:], axis=0)) == LANES


def test_states_in_and_out_have_one_type():
    """With the real physics: shapes, dtypes and no weak types, so that nothing compiles twice."""
    env = envs.make("drawer-open")
    start = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, start, jnp.zeros(4))
    describe = lambda tree: [(x.shape, x.dtype, x.weak_type) for x in jax.tree.leaves(tree)]
    assert describe(start) == describe(after)
    assert jax.tree.structure(start) == jax.tree.structure(after)
    assert not any(weak for *_, weak in describe(start))


def test_legacy_keys_and_the_metrics_of_wrappers_pass_through(no_physics):
    """brax's wrappers add their own entries to info and metrics, and old code has old keys."""
    env = envs.make("drawer-open")
    state = env.reset(jax.random.PRNGKey(0))
    state = state.replace(info=state.info | {"theirs": jnp.ones(())})  # type: ignore[attr-defined]
    after = jax.eval_shape(env.step, state, jnp.zeros(4))
    assert "theirs" in after.info and set(after.metrics) == {"success", "distance"}


@pytest.mark.parametrize(
    ("arguments", "cause", "cure"),
    [
        (("window-opne",), "unknown task 'window-opne'", "did you mean 'window-open'"),
        (("drawer-open", 0), "an episode of 0 steps has no end", "of 1 or more"),
    ],
)
def test_mistakes_name_cause_and_cure(arguments, cause, cure):
    with pytest.raises(ValueError) as error:
        envs.make(*arguments)
    first, second = str(error.value).splitlines()
    assert cause in first and cure in second
    assert "drawer-open" in TASKS
