"""RL2 and MAML on a hidden goal: they learn to adapt, resume exactly, and train several seeds."""

import line_env
import pytest

import cmrl_jax as cj
from cmrl_jax import registry

SMALL = {
    "env.name": "line",
    "env.horizon": line_env.STEPS,
    "env.obs_mode": "metaworld",
    "tasks.train": ["line-left", "line-right"],
    "tasks.test": [],
    "goals.table": "one-hot",
    "collect.lanes": 128,
    "eval.every": 1.0,
    "eval.wall_share": 1.0,
    "eval.goals": 1,
    "eval.final_goals": 2,
}
KEYS = {
    "rl2": {
        "rl2.width": 32,
        "rl2.hidden": 32,
        "rl2.reward_scale": 2.0,
        "ppo.entropy": 0.01,
        "ppo.epochs": 8,
        "ppo.lr": 1e-3,
        "eval.final_k": [0, 1],
        "train.env_steps": 250_000,
    },
    "maml": {"eval.final_k": [0, 8], "train.env_steps": 70_000},
}
SHORT = {"collect.lanes": 16, "train.env_steps": 1}
ITERATION = {"rl2": 16 * 3 * line_env.STEPS, "maml": 16 * 2 * line_env.STEPS}


@pytest.fixture(scope="module", autouse=True)
def registered():
    cj.register_environment("line", line_env.TASKS, "line_env:make")
    yield
    del registry.ENVIRONMENTS["line"]


def config_of(name, **changed):
    return cj.load_config(name, SMALL | KEYS[name] | changed)


def mean_return(agent, k, **options):
    rows = cj.evaluate(agent, k=(k,), goals=50, **options).rows()
    return sum(row["return"] for row in rows) / len(rows)


def test_rl2_remembers_where_the_goal_was(tmp_path):
    """0.95 of the optimum from the second episode on; 0.5 where memory ends with an episode."""
    result = cj.train(config_of("rl2"), tmp_path / "run", loggers=[])
    assert mean_return(result.agent, 0) < 0.75
    assert min(mean_return(result.agent, k) for k in (1, 2)) >= 0.95
    assert mean_return(result.agent, 1, z="prior") < 0.75


def test_one_inner_step_of_maml_leads_to_the_goal(tmp_path):
    """0.9 of the optimum after it, from the episodes of one group; without it, 0.5."""
    result = cj.train(config_of("maml"), tmp_path / "run", loggers=[])
    assert mean_return(result.agent, 8) >= 0.9
    assert mean_return(result.agent, 0) < 0.75
    assert mean_return(result.agent, 8, z="prior") < 0.75


@pytest.mark.parametrize("name", KEYS)
def test_it_resumes_exactly_and_several_seeds_are_each_alone(name, tmp_path):
    steps = {"train.env_steps": 4 * ITERATION[name]}
    config = config_of(name, **SHORT | steps)
    whole = cj.train(config, tmp_path / "whole", loggers=[])
    assert whole.iteration == 4
    stop = cj.Stop()

    class Stopper(cj.Logger):
        def row(self, row, progress):
            if row["iteration"] == 1:
                stop.request()

    assert cj.train(config, tmp_path / "half", loggers=[Stopper()], stop=stop).iteration == 2
    again = cj.train(config, tmp_path / "half", resume=True, loggers=[])
    shown = lambda rows: [{n: x for n, x in row.items() if "_s" not in n} for row in rows]
    assert shown(again.metrics) == shown(whole.metrics)
    first, second = cj.train(config, tmp_path / "two", seeds=2, loggers=lambda config: [])
    for row, alone in zip(first.metrics, whole.metrics, strict=True):
        name = "train/line-left/return"
        assert row[name] == pytest.approx(alone[name], abs=1e-4)
    assert first.metrics != second.metrics


@pytest.mark.parametrize(
    ("name", "changed", "cause", "cure"),
    [
        ("rl2", {"rl2.minibatches": 5}, "collect.lanes 128 cannot be divided into 5", "4"),
        ("maml", {"maml.episodes": 10}, "the 64 lanes of a task are no groups of 10", "8"),
        ("maml", {"maml.hidden": []}, "maml.hidden is empty", "give"),
    ],
)
def test_what_cannot_be_trained_is_refused(name, changed, cause, cure):
    with pytest.raises(cj.ConfigError, match=cause) as raised:
        config_of(name, **changed)
    assert cure in raised.value.cure
