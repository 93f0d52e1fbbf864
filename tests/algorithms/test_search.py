"""The search agent: which arm it tries when, what it credits, and what it acts with."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learner_fixtures import ACT, GOALS, LATENT, OBS, TASKS, build, tiny_config

from cmrl_jax.algorithms.base import Told
from cmrl_jax.algorithms.cmrl.agent import PolicyParams
from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.cmrl.search import BUDGET, ArmsInTurn, Rule, SearchAgent, round_starts
from cmrl_jax.algorithms.common.replay import Transition
from cmrl_jax.nn.context import init_belief

MIRRORS = (
    np.array([[1, 1, 1], [-1, 1, 1]], np.float32),
    np.array([[1, 1], [-1, 1]], np.float32),
)
ARMS, LANES, STEPS = 2 * (TASKS + 1), 3, 10
TOLD = Told(
    np.asarray(GOALS[:1, 1].repeat(LANES, 0)), np.ones(LANES, np.float32), np.zeros(LANES, int)
)


@pytest.fixture(scope="module")
def made():
    return build(tiny_config())


@pytest.fixture(scope="module")
def params(made):
    state = made.state
    task_z = jax.random.normal(jax.random.key(5), (TASKS, LATENT))
    return PolicyParams(state.actor_params, state.encoder_params, state.obs_stats, task_z)


def agent_of(made, rule: Rule = "return"):
    return SearchAgent(made.learner, STEPS, MIRRORS, rule)


def transitions(reward):
    """Steps (lane, time) with these rewards."""
    flag, lead = jnp.zeros(reward.shape, bool), reward.shape
    obs, action = jnp.zeros((*lead, OBS)), jnp.zeros((*lead, ACT))
    return Transition(obs, action, jnp.asarray(reward), flag, flag, flag, obs)


class Trial:
    """Episodes one after the other, whose rewards are a function of the arm."""

    def __init__(self, made, params, value, rule: Rule = "return"):
        self.agent, self.params, self.value = agent_of(made, rule), params, value
        self.memory = self.agent.init(TOLD)
        self.begin = jax.jit(self.agent.begin_episode)
        self.observe = jax.jit(self.agent.observe)

    def play(self, exploit=False):
        """One episode; the arm of each lane (lane,)."""
        keys = jax.random.split(jax.random.key(0), LANES)
        memory = self.begin(self.params, self.memory, self.memory, keys, np.bool_(exploit))
        rewards = [self.value(lane, int(arm)) for lane, arm in enumerate(memory.arm)]
        reward = np.array(rewards, np.float32)
        after = self.observe(
            self.params, memory, transitions(reward), jnp.ones(reward.shape, jnp.float32)
        )
        if not exploit:
            self.memory = after
        return np.asarray(memory.arm)


def constant(lane, arm):
    """Lane l's best arm is 5 + l, the worst ones come first."""
    return np.full(STEPS, 10.0 - abs(arm - 5 - lane))


def test_every_arm_is_tried_once_and_then_fewer_and_fewer_of_the_best(made, params):
    trial = Trial(made, params, constant)
    tried = np.stack([trial.play() for _ in range(BUDGET)])  # (episode, lane)
    assert (np.sort(tried[:ARMS], 0) == np.arange(ARMS)[:, None]).all()
    starts = round_starts(ARMS)
    assert starts[:2] == (0, ARMS) and starts[-1] == BUDGET
    for lane in range(LANES):
        ranked = sorted(range(ARMS), key=lambda arm: abs(arm - 5 - lane))
        for begin, end in zip(starts[1:], starts[2:], strict=False):
            # The best ones, ties in any order; one more than are left are never tried.
            worst = max(abs(arm - 5 - lane) for arm in tried[begin:end, lane])
            assert worst == abs(ranked[end - begin - 1] - 5 - lane)
            assert len(set(tried[begin:end, lane])) == end - begin
    assert (trial.play() == 5 + np.arange(LANES)).all()  # and the best one ever after


def test_rounds_halve_what_is_left():
    assert round_starts(12) == (0, 12, 16, 18, 19, 20)
    assert round_starts(16) == (0, 16, 18, 19, 20)
    assert round_starts(20) == (0, 20) and round_starts(24) == (0, 24)
    for arms in range(1, 20):
        starts = round_starts(arms)
        assert starts[-1] == BUDGET and starts[1] == arms
        sizes = np.diff(starts[1:])
        assert (sizes >= 1).all() and (sizes <= max(arms // 2, 1)).all()


@pytest.mark.parametrize("tasks", [1, 2, 3])
def test_few_arms_are_searched_to_the_end(made, params, tasks):
    """Without mirrors there are 2 to 4: every exploring episode is credited to one of them."""
    identity = np.ones((1, OBS), np.float32), np.ones((1, ACT), np.float32)
    trial = Trial(made, params, lambda lane, arm: np.full(STEPS, float(arm == tasks)))
    config = tiny_config()
    config = replace(config, tasks=replace(config.tasks, train=config.tasks.train[:tasks]))
    few = Learner(config, GOALS[:tasks], OBS, ACT)
    trial.agent = SearchAgent(few, STEPS, identity)
    trial.memory = trial.agent.init(TOLD)
    trial.begin = jax.jit(trial.agent.begin_episode)
    for _ in range(BUDGET + 3):
        assert (trial.play() <= tasks).all()
    assert (trial.play(exploit=True) == tasks).all()
    assert (trial.memory.plays.sum(-1) == BUDGET + 2).all()  # the last is credited when it is over


def test_an_episode_that_counts_takes_the_best_arm_and_teaches_nothing(made, params):
    trial = Trial(made, params, constant)
    assert (trial.play(exploit=True) == 0).all()  # the task's own sentence, before any was tried
    for more, known in ((3, 3), (ARMS - 3, ARMS)):
        for _ in range(more):
            trial.play()
        before = jax.tree.map(np.asarray, trial.memory)
        best = [max(range(known), key=lambda arm: constant(lane, arm)[0]) for lane in range(LANES)]
        assert (trial.play(exploit=True) == best).all()
        jax.tree.map(np.testing.assert_array_equal, before, jax.tree.map(np.asarray, trial.memory))


def test_arms_in_turn_are_played_whatever_they_earn(made, params):
    trial = Trial(made, params, constant)
    trial.agent = ArmsInTurn(made.learner, STEPS, MIRRORS)
    trial.begin = jax.jit(trial.agent.begin_episode)
    for arm in [*range(ARMS), 0, 1]:
        assert (trial.play(exploit=True) == arm).all()
        assert (trial.play() == arm).all()


def test_the_rule_decides_what_is_best(made, params):
    """Arm 1 holds 4.6 for the whole episode; arm 6 reaches 9 in half of it, and earns less."""

    def value(lane, arm):
        reward = np.zeros(STEPS)
        if arm == 1:
            reward[:] = 4.6
        if arm == 6:
            reward[STEPS // 2 :] = 9.0
        return reward

    by_rule: dict[Rule, int] = {"return": 1, "late": 6}
    for rule, best in by_rule.items():
        trial = Trial(made, params, value, rule)
        for _ in range(ARMS):
            trial.play()
        assert (trial.play(exploit=True) == best).all(), rule


def test_a_step_that_is_masked_earns_nothing(made, params):
    agent = agent_of(made, "return")
    memory = replace(agent.init(TOLD), learns=jnp.ones(LANES))
    reward, mask = np.ones((LANES, STEPS), np.float32), np.ones((LANES, STEPS), np.float32)
    mask[1, 3:] = 0
    after = agent.observe(params, memory, transitions(reward), jnp.asarray(mask))
    np.testing.assert_array_equal(after.score, [STEPS, 3, STEPS])


def test_late_rewards_are_averaged_the_last_ones_most(made, params):
    agent, rate = agent_of(made, "late"), 1 / 50
    reward = np.random.default_rng(0).normal(size=(LANES, STEPS)).astype(np.float32)
    mask = np.ones_like(reward)
    mask[1, 3:], mask[2] = 0, 0
    memory = agent.init(TOLD)
    for _ in range(2):
        memory = agent.observe(params, memory, transitions(reward), jnp.asarray(mask))
    for lane, length in enumerate((STEPS, 3, 0)):
        average = 0.0
        for x in np.tile(reward[lane, :length], 2):
            average += rate * (x - average)
        np.testing.assert_allclose(memory.score[lane], average, rtol=1e-5)


def test_an_arm_is_a_tasks_z_in_a_mirror(made, params):
    """Action of arm (z, mirror) = mirrored action of the policy, told z, on mirrored obs."""
    agent, learner = agent_of(made), made.learner
    k_obs, k_noise = jax.random.split(jax.random.key(1))
    obs, noise = jax.random.normal(k_obs, (LANES, OBS)), jax.random.normal(k_noise, (LANES, ACT))
    own = learner.inference.posterior_of_belief(
        params.encoder_params, init_belief((1,), LATENT), TOLD.text[:1], jnp.ones(1)
    )
    z_of = np.concatenate([own.mean, params.task_z])
    keys = jax.random.split(jax.random.key(0), LANES)
    trial = Trial(made, params, constant)
    for tried in range(ARMS):
        begun = trial.begin(params, trial.memory, trial.memory, keys, np.bool_(False))
        assert (begun.arm == tried).all()
        z = np.broadcast_to(z_of[tried // 2], (LANES, LATENT))
        np.testing.assert_allclose(begun.z, z, rtol=1e-5)
        of_obs, of_action = (signs[tried % 2] for signs in MIRRORS)
        wanted, _ = learner.policy(
            params.actor_params, params.obs_stats, obs * of_obs, z, None, False, noise
        )
        got = agent.act(params, begun, obs, noise, False)
        np.testing.assert_allclose(got, wanted * of_action, rtol=1e-5)
        trial.play()


def test_another_lanes_experience_decides_what_is_acted_on(made, params):
    trial = Trial(made, params, constant)
    for _ in range(ARMS):
        trial.play()
    keys = jax.random.split(jax.random.key(0), LANES)
    donor = np.array([1, 2, 0])
    source = jax.tree.map(lambda x: x[donor], trial.memory)
    begun = trial.begin(params, trial.memory, source, keys, np.bool_(True))
    assert begun.arm.tolist() == [6, 7, 5]
