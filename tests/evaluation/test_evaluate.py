"""The meta-test protocol on native physics, beside a plain-python account of it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from policy_fixtures import HORIZON, MovingEnv, random_policy, small_config

from cmrl_jax.algorithms.common.replay import Transition
from cmrl_jax.evaluation.controls import donors
from cmrl_jax.evaluation.evaluator import Evaluator, Trial, lane_names
from cmrl_jax.evaluation.options import MOST_DRAWS, Z_CONTROLS
from cmrl_jax.evaluation.session import Session
from envs.goal_names import GOALS
from envs.tasks import METAWORLD_TASKS as TASKS
from envs.tasks import task_id

LANES = 5  # of a batch: fewer than any evaluation here has, and no divisor of them


@pytest.fixture(scope="module")
def session():
    session = Session(small_config())
    session.env = MovingEnv()
    return session


@pytest.fixture(scope="module")
def counted(session):
    """The evaluator of all tests, and lists that grow with its traces and compilations."""
    traces, compiles, env = [], [], MovingEnv()
    step, compile_ = env.step, jax.stages.Lowered.compile
    env.step = lambda state, action: traces.append(1) or step(state, action)
    counting = lambda self, *a, **k: compiles.append(1) or compile_(self, *a, **k)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax.stages.Lowered, "compile", counting)
        yield Evaluator(session.config, env, session.agent, LANES, policies=2), traces, compiles


@pytest.fixture(scope="module")
def evaluator(counted):
    return counted[0]


@pytest.fixture(scope="module")
def policy(session):
    return random_policy(session, 1)


@pytest.fixture(scope="module")
def trial(session):
    return replace(session.trial("heldout", 2), draws=2)


@pytest.fixture(scope="module")
def scores(evaluator, policy, trial):
    """k 0, 1, 2 of every z source; 4 tasks, 2 goals, 2 draws."""
    return {z: evaluator.run([policy], replace(trial, z=z), (0, 1, 2), seed=3) for z in Z_CONTROLS}


def in_plain_python(session, params, trial, episodes, seed):
    """Scores of each episode, {field: (episode, lane)}, one step and one lane at a time.

    The posterior is taken afresh over the list of all transitions of a lane.
    """
    learner, inference = session.algorithm.parts, session.algorithm.parts.inference
    step = jax.jit(jax.vmap(session.env.step))
    posterior_of = jax.jit(inference.posterior)
    lanes = [
        (task, goal, draw)
        for task in range(len(trial.tasks))
        for goal in range(trial.placements.shape[1])
        for draw in range(trial.draws)
    ]
    ids = np.array([task_id(trial.tasks[t]) for t, _, _ in lanes])
    names = np.array([d * 4000 + i * 1000 + g for i, (_, g, d) in zip(ids, lanes, strict=True)])
    texts = [trial.texts[0, t, g] for t, g, _ in lanes]
    source = list(range(len(lanes)))
    if trial.z == "other":
        place = {(int(i), *lane[1:]): n for n, (i, lane) in enumerate(zip(ids, lanes, strict=True))}
        source = [place[(int(i) + 1) % 4, g, d] for i, (_, g, d) in zip(ids, lanes, strict=True)]
    elif trial.z == "shuffled":
        source = donors("shuffled", names, ids)
    normalize = lambda obs: learner.normalize_obs(params.obs_stats, jnp.stack(obs))
    memory = [[] for _ in lanes]
    results = []
    for episode in range(episodes):
        key = jax.random.fold_in(jax.random.key(seed), episode)
        z_key = jax.random.split(key)[0]
        latents = []
        for lane, name in enumerate(names):
            seen = memory[source[lane]]
            none = jnp.zeros((1, 39)), jnp.zeros((1, 4)), jnp.zeros(1), jnp.zeros((1, 39))
            o, a, r, o2 = none
            if seen:
                o, a, r, o2 = (list(x) for x in zip(*seen, strict=True))
                o, a, r, o2 = normalize(o), jnp.stack(a), jnp.stack(r), normalize(o2)
            flag = jnp.zeros(len(r), bool)
            posterior = posterior_of(
                params.encoder_params,
                Transition(o, a, r, flag, flag, flag, o2),
                jnp.full(len(r), float(bool(seen))),
                texts[source[lane]],
                jnp.ones(()),
            )
            latents.append(inference.sample_z(jax.random.fold_in(z_key, int(name)), posterior))
        placement = jnp.asarray([trial.placements[t, g] for t, g, _ in lanes], jnp.float32)
        state = jax.vmap(session.env.reset_to)(jnp.asarray(ids), placement)
        rewards, successes = [], []
        new = [[] for _ in lanes]
        for _ in range(HORIZON):
            action, _ = learner.policy(
                params.actor_params, params.obs_stats, state.obs, jnp.stack(latents), key, True
            )
            after = step(state, action)
            for lane in range(len(lanes)):
                new[lane].append(
                    (state.obs[lane], action[lane], after.reward[lane], after.obs[lane])
                )
            rewards.append(np.asarray(after.reward))
            successes.append(np.asarray(after.success))
            state = after
        memory = [old + added for old, added in zip(memory, new, strict=True)]
        hits = [[t for t, step in enumerate(successes) if step[n]] for n in range(len(lanes))]
        results.append(
            {
                "returns": np.sum(rewards, 0),
                "success_any": np.array([bool(h) for h in hits]),
                "success_last": successes[-1],
                "first_success": np.array([h[0] if h else HORIZON for h in hits]),
                "final_distance": np.asarray(state.distance),
            }
        )
    return {name: np.array([result[name] for result in results]) for name in results[0]}


@pytest.mark.parametrize("z", ["posterior", "shuffled", "other"])
def test_scores_are_those_of_a_plain_account_of_the_protocol(session, policy, trial, scores, z):
    wanted = in_plain_python(session, policy, replace(trial, z=z), 3, seed=3)
    for name, values in wanted.items():
        found = [getattr(scores[z][k], name)[0].ravel() for k in (0, 1, 2)]
        np.testing.assert_allclose(found, values, atol=5e-4, err_msg=name)
    # Far more than the tolerance: episodes do differ, and successes too.
    assert np.ptp(wanted["returns"], axis=0).min() > 0.02
    assert np.any(wanted["success_any"] != wanted["success_last"])
    assert len(np.unique(wanted["first_success"])) > 2


def test_the_order_of_tasks_changes_no_number(evaluator, policy, trial, scores):
    """Trap 8: a belief that outlived its task, or a donor found by place, would show here."""
    back = replace(
        trial,
        tasks=trial.tasks[::-1],
        placements=trial.placements[::-1],
        texts=trial.texts[:, ::-1],
    )
    for z in Z_CONTROLS:
        found = evaluator.run([policy], replace(back, z=z), (0, 2), seed=3)
        for k in (0, 2):
            for a, b in zip(found[k], scores[z][k], strict=True):
                np.testing.assert_allclose(a[:, ::-1], b, rtol=1e-5, err_msg=f"{z} {k}")


def test_a_lane_scores_alone_as_it_does_among_others(evaluator, policy, trial, scores):
    alone = replace(trial, tasks=trial.tasks[2:3], placements=trial.placements[2:3], draws=1)
    alone = replace(alone, texts=trial.texts[:, 2:3]).of_goal(1)
    found = evaluator.run([policy], alone, (0, 2), seed=3)
    for k in (0, 2):
        wanted = scores["posterior"][k].returns[0, 2, 1, 0]
        np.testing.assert_allclose(found[k].returns.item(), wanted, rtol=1e-5)


def test_draws_and_seeds_are_different_latents(evaluator, policy, trial, scores):
    returns = scores["posterior"][0].returns[0]
    assert np.all(returns[..., 0] != returns[..., 1])
    other = evaluator.run([policy], trial, (0,), seed=4)[0].returns[0]
    assert np.all(other != returns)


def test_policies_side_by_side_score_as_one_by_one(session, evaluator, policy, trial, scores):
    second = random_policy(session, 2)
    texts = np.concatenate([trial.texts[:, ::-1], trial.texts])
    both = evaluator.run(
        [second, policy], replace(trial, z="shuffled", texts=texts), (0, 1), seed=3
    )
    alone = replace(trial, z="shuffled", texts=texts[:1])
    alone = evaluator.run([second], alone, (0, 1), seed=3)
    np.testing.assert_allclose(both[1].returns[0], alone[1].returns[0], rtol=1e-5)
    np.testing.assert_allclose(both[1].returns[1], scores["shuffled"][1].returns[0], rtol=1e-5)
    assert np.all(both[1].returns[0] != both[1].returns[1])


def changed(params, part):
    """The policy with the encoder's networks of one input changed: `transitions` or `goal`."""
    is_goal = lambda path: "goal" in jax.tree_util.keystr(path)
    move = lambda path, x: x + 0.1 if is_goal(path) == (part == "goal") else x
    encoder = jax.tree_util.tree_map_with_path(move, params.encoder_params)
    return params._replace(encoder_params=encoder)


def test_controls_take_z_from_where_they_say(evaluator, policy, trial, scores):
    returns = {z: [scores[z][k].returns[0] for k in (0, 1, 2)] for z in Z_CONTROLS}
    run = lambda params, z: evaluator.run([params], replace(trial, z=z), (0, 2), seed=3)
    for z in ("prior", "shuffled", "other", "text"):
        assert np.all(returns[z][2] != returns["posterior"][2]), z
    # Before any experience the posterior is the text's.
    np.testing.assert_array_equal(returns["text"][0], returns["posterior"][0])
    # The prior knows neither experience nor text: the encoder makes no difference.
    for part in ("transitions", "goal"):
        found = run(changed(policy, part), "prior")
        np.testing.assert_array_equal(found[0].returns[0], returns["prior"][0])
        np.testing.assert_array_equal(found[2].returns[0], returns["prior"][2])
    # The text's z knows the text alone.
    moved = {part: run(changed(policy, part), "text")[2].returns[0] for part in ("transitions",)}
    np.testing.assert_array_equal(moved["transitions"], returns["text"][2])
    assert np.all(run(changed(policy, "goal"), "text")[2].returns[0] != returns["text"][2])


def test_another_text_changes_the_score(evaluator, policy, trial, scores):
    found = evaluator.run([policy], replace(trial, texts=trial.texts[:, ::-1]), (0,), seed=3)
    assert np.all(found[0].returns != scores["posterior"][0].returns)


def test_sampled_actions(evaluator, policy, trial, scores):
    """Trap 7: the flag is heeded, and a lane's noise is its own."""
    sampled = replace(trial, deterministic=False, z="prior")
    first, again = (evaluator.run([policy], sampled, (0,), seed=3)[0] for _ in range(2))
    np.testing.assert_array_equal(first.returns, again.returns)
    assert np.all(first.returns != scores["prior"][0].returns)
    back = replace(sampled, tasks=trial.tasks[::-1], placements=trial.placements[::-1])
    found = evaluator.run([policy], back, (0,), seed=3)[0].returns[:, ::-1]
    np.testing.assert_allclose(found, first.returns, rtol=1e-5)


def test_all_of_it_is_one_program(counted, scores):
    """Runs last: whatever was evaluated above, controls, subsets and draws, was traced once."""
    _, traces, compiles = counted
    assert (len(traces), len(compiles)) == (1, 1) and scores


@pytest.mark.parametrize("goals", [1, 3])
def test_donors(goals):
    env_task = np.repeat([2, 0, 3], goals)  # three of the tasks, in any order
    lane_id = env_task * 1000 + np.tile(np.arange(goals), 3)
    own = np.arange(3 * goals)
    shuffled = donors("shuffled", lane_id, env_task)
    assert sorted(shuffled) == list(own) and np.all(shuffled != own)
    other = donors("other", lane_id, env_task)
    assert sorted(other) == list(own)
    np.testing.assert_array_equal(lane_id[other] % 1000, lane_id % 1000)  # the same goal
    assert dict(zip(env_task, env_task[other], strict=True)) == {0: 2, 2: 3, 3: 0}
    # Places are read from the lanes' names: another order of lanes, the same donors.
    back = slice(None, None, -1)
    for found, donor in (
        (donors("shuffled", lane_id[back], env_task[back]), shuffled),
        (donors("other", lane_id[back], env_task[back]), other),
    ):
        wanted = dict(zip(lane_id, lane_id[donor], strict=True))
        assert dict(zip(lane_id[back], lane_id[back][found], strict=True)) == wanted


def test_shuffled_donors_mix_tasks():
    env_task = np.repeat(np.arange(len(TASKS)), 50)
    lane_id = env_task * 1000 + np.tile(np.arange(50), 4)
    donor = donors("shuffled", lane_id, env_task)
    share = np.mean(env_task[donor] != env_task)
    assert 0.6 < share < 0.9  # 3/4 by chance


def test_a_fault_while_adapting_counts_for_what_was_adapted(evaluator, policy, trial, monkeypatch):
    """A lane that was put back in an exploration episode is not clean at later k."""
    play, played = evaluator._play, []

    def faulty(*args):
        memories, score = play(*args)
        played.append(score)
        return memories, score._replace(faults=score.faults + (len(played) == 2))

    monkeypatch.setattr(evaluator, "_play", faulty)
    scores = evaluator.run([policy], trial, (0, 1, 2), seed=3)
    assert [int(scores[k].faults.max()) for k in (0, 1, 2)] == [0, 1, 1]
    assert [int(scores[k].faults.min()) for k in (0, 1, 2)] == [0, 1, 1]


def test_lanes_of_the_most_draws_have_names_of_their_own():
    texts = np.zeros((1, 4, GOALS, 1))
    names = lane_names(Trial(TASKS, np.zeros((4, GOALS, 3)), texts, draws=MOST_DRAWS), TASKS)
    assert len(np.unique(names)) == 4 * GOALS * MOST_DRAWS and names.min() >= 0
