"""The search agent: which arm it tries when, what it credits, and what it acts with."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from learner_fixtures import ACT, GOALS, LATENT, OBS, TASKS, build, tiny_config

from cmrl_jax.algorithms.base import Told
from cmrl_jax.algorithms.cmrl import search
from cmrl_jax.algorithms.cmrl.agent import PolicyParams
from cmrl_jax.algorithms.cmrl.learner import Learner
from cmrl_jax.algorithms.cmrl.search import BUDGET, ArmsInTurn, SearchAgent, rounds_of
from cmrl_jax.algorithms.common.replay import Transition
from cmrl_jax.nn.context import init_belief

# The identity, and a quarter turn of the first two numbers: its inverse is another matrix.
TURN = np.eye(3, dtype=np.float32)
TURN[:2, :2] = [[0, 1], [-1, 0]]
VIEWS = np.stack([np.eye(OBS, dtype=np.float32), TURN]), np.stack([np.eye(ACT), TURN[:2, :2]])
# As it is, and with the last number as half and as twice what it is.
REACHES = np.stack([np.diag([1.0, 1.0, seen]).astype(np.float32) for seen in (1.0, 0.5, 2.0)])
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


def agent_of(made, reaches=REACHES[:1]):
    return SearchAgent(made.learner, STEPS, VIEWS, reaches)


def transitions(reward):
    """Steps (lane, time) with these rewards."""
    flag, lead = jnp.zeros(reward.shape, bool), reward.shape
    obs, action = jnp.zeros((*lead, OBS)), jnp.zeros((*lead, ACT))
    return Transition(obs, action, jnp.asarray(reward), flag, flag, flag, obs)


class Trial:
    """Episodes one after the other, whose rewards are a function of the arm."""

    def __init__(self, made, params, value, reaches=REACHES[:1]):
        self.agent, self.params, self.value = agent_of(made, reaches), params, value
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
    kept, starts, _ = trial.agent.rounds
    assert kept == 2 and starts[:3] == (0, 2, ARMS) and starts[-1] == BUDGET
    for lane in range(LANES):
        ranked = sorted(range(ARMS), key=lambda arm: abs(arm - 5 - lane))
        for begin, end in zip(starts[2:], starts[3:], strict=False):
            # The best ones, ties in any order; one more than are left are never tried.
            worst = max(abs(arm - 5 - lane) for arm in tried[begin:end, lane])
            assert worst == abs(ranked[end - begin - 1] - 5 - lane)
            assert len(set(tried[begin:end, lane])) == end - begin
    assert (trial.play() == 5 + np.arange(LANES)).all()  # and the best one ever after


def test_the_own_z_is_tried_first_and_says_in_which_views_the_others_are(made, params, monkeypatch):
    """Lane 0's own z earns more in the turned view, the others' more as it is."""
    monkeypatch.setattr(search, "BUDGET", 6)  # of two views one is kept
    monkeypatch.setattr(search, "rounds_of", functools.partial(rounds_of, budget=6))
    assert rounds_of(2, TASKS, budget=6).views == 1
    better = [1, 0, 0]
    value = lambda lane, arm: np.full(STEPS, float(arm % 2 == better[lane]) + 0.1 * arm)
    trial = Trial(made, params, value)
    tried = np.stack([trial.play() for _ in range(2 + TASKS)])
    assert (tried[:2] == [[0], [1]]).all()
    np.testing.assert_array_equal(tried[2:, 0], [3, 5, 7])
    np.testing.assert_array_equal(tried[2:, 1:], [[2, 2], [4, 4], [6, 6]])
    assert (trial.play(exploit=True) == [7, 6, 6]).all()


def test_the_best_arm_is_tried_with_every_other_reach(made, params):
    """Lane l's best z and view is 5 + l; it earns most with the last reach, in lane 1 the first."""
    sign = [1, -1, 1]
    value = lambda lane, arm: constant(lane, arm % ARMS) + 0.1 * sign[lane] * (arm // ARMS)
    trial = Trial(made, params, value, REACHES)
    tried = np.stack([trial.play() for _ in range(BUDGET)])
    best = 5 + np.arange(LANES)
    begin = trial.agent.rounds.reaching
    assert begin is not None and begin > ARMS and (tried[:begin] < ARMS).all()
    np.testing.assert_array_equal(tried[begin : begin + 2], [ARMS + best, 2 * ARMS + best])
    # After it the best arms again, whatever their reach.
    won = best + np.array([2, 0, 2]) * ARMS
    assert (tried[begin + 2] == won).all()
    assert (trial.play(exploit=True) == won).all()
    assert trial.agent.describe(trial.memory)[0].endswith(", reach 2")


def test_rounds_end_with_the_budget_and_halve_what_is_left():
    # Meta-World's views and reaches, three training tasks.
    assert rounds_of(8, 3, 2) == (2, (0, 8, 14, 17, 18, 19, 20), 17)
    assert rounds_of(8, 3) == (2, (0, 8, 14, 17, 18, 19, 20), None)
    assert rounds_of(8, 3, 5).reaching is None  # three episodes are left, too few
    for views in range(1, 9):
        for tasks in range(1, 10):
            for reaches in (1, 3):
                kept, starts, reaching = rounds_of(views, tasks, reaches)
                assert 1 <= kept <= views and starts[:2] == (0, views)
                assert starts[2] == views + kept * tasks and starts[-1] == BUDGET
                sizes = dict(zip(starts[2:], np.diff(starts[2:]), strict=False))
                if reaching is not None:
                    assert reaching == starts[3] and sizes.pop(reaching) == reaches - 1
                assert all(1 <= size <= max(starts[2] // 2, 1) for size in sizes.values())


@pytest.mark.parametrize("tasks", [1, 2, 3])
def test_few_arms_are_searched_to_the_end(made, params, tasks):
    """Without mirrors there are 2 to 4: every exploring episode is credited to one of them."""
    identity = np.eye(OBS, dtype=np.float32)[None], np.eye(ACT, dtype=np.float32)[None]
    trial = Trial(made, params, lambda lane, arm: np.full(STEPS, float(arm == tasks)))
    config = tiny_config()
    config = replace(config, tasks=replace(config.tasks, train=config.tasks.train[:tasks]))
    few = Learner(config, GOALS[:tasks], OBS, ACT)
    trial.agent = SearchAgent(few, STEPS, identity, REACHES[:1])
    trial.memory = trial.agent.init(TOLD)
    trial.begin = jax.jit(trial.agent.begin_episode)
    for _ in range(BUDGET + 3):
        assert (trial.play() <= tasks).all()
    assert (trial.play(exploit=True) == tasks).all()
    assert (trial.memory.plays.sum(-1) == BUDGET + 2).all()  # the last is credited when it is over


def test_an_episode_that_counts_takes_the_best_arm_and_teaches_nothing(made, params):
    trial = Trial(made, params, constant)
    assert (trial.play(exploit=True) == 0).all()  # the task's own sentence, before any was tried
    tried = []
    for more in (3, ARMS - 3):
        tried += [trial.play() for _ in range(more)]
        before = jax.tree.map(np.asarray, trial.memory)
        by_lane = np.stack(tried, 1)
        best = [max(arms, key=lambda arm: constant(i, arm)[0]) for i, arms in enumerate(by_lane)]
        assert (trial.play(exploit=True) == best).all()
        jax.tree.map(np.testing.assert_array_equal, before, jax.tree.map(np.asarray, trial.memory))


def test_arms_in_turn_are_played_whatever_they_earn(made, params):
    trial = Trial(made, params, constant)
    trial.agent = ArmsInTurn(made.learner, STEPS, VIEWS, REACHES[:1])
    trial.begin = jax.jit(trial.agent.begin_episode)
    for arm in [*range(ARMS), 0, 1]:
        assert (trial.play(exploit=True) == arm).all()
        assert (trial.play() == arm).all()


def test_what_moves_late_beats_what_waits(made, params):
    """Arm 1 earns 5 throughout; arm 6 nothing, then 9: less in all, more at its best."""

    def value(lane, arm):
        reward = np.zeros(STEPS)
        if arm == 1:
            reward[:] = 5.0
        if arm == 6:
            reward[STEPS // 2 :] = 9.0
        return reward

    trial = Trial(made, params, value)
    for _ in range(ARMS + 1):  # what is played last is credited when the next begins
        trial.play()
    assert (trial.play(exploit=True) == 6).all()
    waits, moves = ((sum(value(0, a)), max(value(0, a))) for a in (1, 6))
    horizon = made.learner.config.env.horizon
    wanted = [earned + horizon * peak for earned, peak in (waits, moves)]
    found = trial.memory.credit[0, [1, 6]] / trial.memory.plays[0, [1, 6]]
    np.testing.assert_allclose(found, wanted, rtol=1e-6)


def test_a_window_with_a_masked_step_is_no_peak(made, params):
    """Rewards of -3, then -1; of the second window one step is masked in lane 1, all in lane 2."""
    agent = agent_of(made)
    reward = np.full((LANES, STEPS + 2), -3.0, np.float32)
    reward[:, 5:10] = -1.0
    mask = np.ones_like(reward)
    mask[1, 7], mask[2] = 0, 0
    after = agent.observe(params, agent.init(TOLD), transitions(reward), jnp.asarray(mask))
    np.testing.assert_array_equal(after.peak, [-1, -3, -np.inf])


def test_a_step_that_is_masked_earns_nothing(made, params):
    agent = agent_of(made)
    memory = replace(agent.init(TOLD), learns=jnp.ones(LANES))
    reward, mask = np.ones((LANES, STEPS), np.float32), np.ones((LANES, STEPS), np.float32)
    mask[1, 3:] = 0
    after = agent.observe(params, memory, transitions(reward), jnp.asarray(mask))
    np.testing.assert_array_equal(after.returns, [STEPS, 3, STEPS])


def test_an_arm_is_a_tasks_z_in_a_view_with_a_reach(made, params):
    """Action of arm (z, view, reach) = the policy's on what the arm sees, turned back."""
    learner = made.learner
    k_obs, k_noise = jax.random.split(jax.random.key(1))
    obs, noise = jax.random.normal(k_obs, (LANES, OBS)), jax.random.normal(k_noise, (LANES, ACT))
    own = learner.inference.posterior_of_belief(
        params.encoder_params, init_belief((1,), LATENT), TOLD.text[:1], jnp.ones(1)
    )
    z_of = np.concatenate([own.mean, params.task_z])
    keys = jax.random.split(jax.random.key(0), LANES)
    trial = Trial(made, params, lambda lane, arm: np.full(STEPS, float(arm)), REACHES)
    seen_with = set()
    for _ in range(BUDGET):
        begun = trial.begin(params, trial.memory, trial.memory, keys, np.bool_(False))
        [arm] = set(begun.arm.tolist())
        reach, rest = divmod(arm, ARMS)
        seen_with.add(reach)
        z = np.broadcast_to(z_of[rest // 2], (LANES, LATENT))
        np.testing.assert_allclose(begun.z, z, rtol=1e-5)
        of_obs, of_action = (matrices[rest % 2] for matrices in VIEWS)
        of_obs = REACHES[reach] @ of_obs
        for found, wanted in zip(trial.agent.matrices(arm), (of_obs, of_action), strict=True):
            np.testing.assert_array_equal(found, wanted)
        seen, _ = learner.policy(
            params.actor_params, params.obs_stats, obs @ of_obs.T, z, None, False, noise
        )
        got = trial.agent.act(params, begun, obs, noise, False)
        np.testing.assert_allclose(got @ of_action.T, seen, rtol=1e-5, atol=1e-6)
        trial.play()
    assert seen_with == {0, 1, 2}


def test_another_lanes_experience_decides_what_is_acted_on(made, params):
    trial = Trial(made, params, constant)
    for _ in range(ARMS):
        trial.play()
    keys = jax.random.split(jax.random.key(0), LANES)
    donor = np.array([1, 2, 0])
    source = jax.tree.map(lambda x: x[donor], trial.memory)
    begun = trial.begin(params, trial.memory, source, keys, np.bool_(True))
    assert begun.arm.tolist() == [6, 7, 5]
