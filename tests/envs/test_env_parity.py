"""`python -m envs.parity.__main__`: what it writes, what it refuses."""

import json

import numpy as np
import pytest
from env_fixtures import GOALS_A_TASK, LANES

from envs.parity import __main__ as parity
from envs.parity import parts as parity_parts
from envs.parity.report import finite, table
from envs.tasks import METAWORLD_TASKS as TASKS

RUN = ("--goals", str(GOALS_A_TASK), "--horizon", "12")
CLOSED = ("success_any", "success_last", "return_ratio", "reference_success_any")
CLOSED += ("reference_success_last", "first_success_step", "reference_first_success_step")


@pytest.fixture
def compiled(monkeypatch, port):
    """The tool with the step that the other tests have compiled."""

    def same(lanes, physics):
        assert (lanes, physics) == (LANES, "mjx")
        return port

    monkeypatch.setattr(parity_parts, "Port", same)


@pytest.mark.slow
def test_all_parts(compiled, tmp_path, capsys):
    file = tmp_path / "parity.json"
    assert parity.main([*RUN, "--json", str(file)]) == 0
    text, result = capsys.readouterr().out, json.loads(file.read_text())
    assert [f"\n{part}. " in text for part in range(1, 6)] == [True] * 5
    assert list(result["tasks"]) == list(TASKS)
    assert (result["goals"], result["horizon"], result["goal_set"]) == (3, 12, "heldout")
    assert result["versions"]["mujoco"] == result["versions"]["mujoco-mjx"]
    for task in result["tasks"].values():
        assert set(CLOSED) <= set(task)
        assert task["first_success_step"] is None  # nobody succeeds in twelve steps
        assert 0.9 < task["return_ratio"] < 1.1
        assert task["injected"]["obs_max"] < 3e-6 and task["injected"]["reward_max"] < 1e-4
        assert task["injected"]["success_mismatches"] == 0
        assert {"p50", "p99", "max", "contact", "no_contact"} <= set(task["one_step"])
        assert list(task["open_loop"]) == ["1", "10"]
        assert task["reset_obs_max"] < 2e-7
        assert list(task["closed_loop"]) == ["0", "0.3"]


@pytest.mark.slow
def test_policies_only_with_noise_and_seed(compiled, tmp_path, capsys, monkeypatch):
    asked = []
    load = parity.load_goal_set
    monkeypatch.setattr(parity, "load_goal_set", lambda name: asked.append(name) or load("train"))
    file = tmp_path / "parity.json"
    words = [*RUN, "--policies", "--noise", "0.5", "--seed", "11", "--json", str(file)]
    assert parity.main(words) == 0
    result = json.loads(file.read_text())
    assert asked == ["fresh:11"] == [result["goal_set"]]
    assert (result["noise"], result["seed"]) == (0.5, 11)
    task = result["tasks"]["drawer-open"]
    assert set(CLOSED) <= set(task) and "injected" not in task
    assert list(task["closed_loop"]) == ["0.5"]
    assert "1. " not in capsys.readouterr().out.split("\n4. ")[0]


@pytest.mark.parametrize(("seed", "name"), [(0, "train"), (1000, "heldout")])
def test_a_packaged_sets_seed_is_called_by_its_name(monkeypatch, seed, name):
    measured = lambda physics, goal_set, *rest: pytest.fail(f"measured {goal_set}")
    monkeypatch.setattr(parity, "measure", measured)
    with pytest.raises(pytest.fail.Exception, match=f"^measured {name}$"):
        parity.main(["--seed", str(seed)])


def test_both_sides_get_the_same_noise(port):
    goals = np.zeros((4, GOALS_A_TASK, 3))
    noise = parity_parts.draw_noise(goals, 30, 0.3, seed=5)
    assert noise.shape == (4, GOALS_A_TASK, 30, 4)
    np.testing.assert_array_equal(noise, parity_parts.draw_noise(goals, 30, 0.3, seed=5))
    assert abs(noise.std() - 0.3) < 0.02
    assert not np.array_equal(noise, parity_parts.draw_noise(goals, 30, 0.3, seed=6))


def test_figures_of_a_comparison():
    """Two goals, four steps, by hand."""
    reward = np.array([[1.0, 2, 3, 4], [0, 0, 0, 0]])
    success = np.array([[0, 0, 1, 0], [0, 0, 0, 0]], bool)
    their_success = np.array([[0, 1, 1, 1], [0, 0, 0, 1]], bool)
    figures = parity_parts._compare(reward, success, 2 * reward, their_success)
    expected = {"success_any": 0.5, "success_last": 0.0, "return": 5.0, "first_success_step": 3.0}
    expected |= {"return_ratio": 0.5, "reference_success_any": 1.0, "reference_success_last": 1.0}
    expected |= {"reference_return": 10.0, "reference_first_success_step": 3.0}
    assert figures == expected


def test_tables_align_and_json_has_no_nan():
    text = table("title", ("task", "any"), [["drawer-open", 1.0], ["x", float("nan")]])
    lines = ["title", "  task           any", "  drawer-open  1.000", "  x                -"]
    assert text.splitlines() == lines
    assert finite({"a": {"b": float("nan"), "c": 1.5}}) == {"a": {"b": None, "c": 1.5}}


@pytest.mark.parametrize(
    ("words", "cause", "cure"),
    [
        (["--goals", "51"], "51 is no whole number from 1 to 50", "50 goals a task"),
        (["--goals", "0"], "--goals: 0 is no whole number from 1 to 50", "a task"),
        (["--goals", "few"], "argument --goals: few is no whole number", "in this range"),
        (["--polices"], "unrecognized arguments: --polices", "--help"),
        (["--physics", "warp"], "unknown physics backend 'warp'", "mjx or native"),
        (["--horizon", "501"], "501 is no whole number from 1 to 500", "end at 500"),
        (["--noise", "-1"], "--noise -1.0 is no standard deviation", "0.3"),
        (["--seed", "-1"], "--seed: -1 is no whole number from 0", "in this range"),
        (["--seed", "2147483648"], "from 0 to 2147483647", "in this range"),
        (["--goal-set", "hedlout"], "'hedlout' is no goal set", "did you mean 'heldout'"),
        (["--json", "/dev/null/x.json"], "cannot write /dev/null/x.json", "give --json"),
    ],
)
def test_mistakes_are_two_lines_and_exit_code_2(words, cause, cure, capsys):
    assert parity.main(words) == 2
    out, err = capsys.readouterr()
    first, second = err.splitlines()
    assert out == "" and first.startswith("error: ") and second.startswith("fix: ")
    assert cause in first and cure in second
