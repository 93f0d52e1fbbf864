"""Means, intervals and the CSV of cells, without any physics."""

import csv

import numpy as np
import pytest

from cmrl_jax.evaluation.cells import COLUMNS, FIGURES, CellTable
from cmrl_jax.evaluation.episode import Episode
from cmrl_jax.evaluation.scores import (
    cell_rows,
    format_scores,
    of_policy,
    summarise,
    summarise_rows,
)
from cmrl_jax.evaluation.statistics import wilson_interval

TASKS = ("window-open", "window-close")
COMMON = {
    "run": "runs/a", "checkpoint": 20, "policy_sha256": None,
    "config": "cmrl", "train_seed": 0, "env_steps": 9,
    "physics": "mjx", "horizon": 200, "goal_set": "heldout", "policy": "deterministic",
    "z": "posterior", "adapt": "posterior", "protocol": "goal",
    "donors": None, "paraphrases": "train", "text_control": "none", "text": None,
    "sentences": None, "eval_seed": 0,
}  # fmt: skip


def episode(seed, shape=(2, 2, 5, 3)):
    """An Episode of random scores (policy, task, goal, draw)."""
    generator = np.random.default_rng(seed)
    number = lambda: generator.normal(100, 20, shape).astype(np.float32)
    flag = lambda: generator.random(shape) < 0.6
    step = generator.integers(0, 200, shape)
    fields = (flag(), flag(), number(), step, number(), np.zeros(shape, np.int32))
    return Episode(*fields)


def assert_summaries_agree(found, wanted):
    """Equal but for rounding: {task: {k: {figure: mean, "interval_95": {figure: [..]}}}}."""
    assert found.keys() == wanted.keys()
    for task, by_k in wanted.items():
        assert found[task].keys() == by_k.keys()
        for k, figures in by_k.items():
            got = dict(found[task][k])
            assert got.pop("interval_95").keys() == figures["interval_95"].keys()
            for name, interval in figures["interval_95"].items():
                np.testing.assert_allclose(
                    found[task][k]["interval_95"][name], interval, rtol=1e-5, err_msg=name
                )
            means = {name: value for name, value in figures.items() if name != "interval_95"}
            assert got == pytest.approx(means, rel=1e-5)


SCORES = {0: episode(0), 2: episode(1)}


def test_means_over_goals_and_draws():
    summary = summarise(of_policy(SCORES, 1), TASKS)
    assert list(summary) == list(TASKS) and list(summary["window-open"]) == ["0", "2"]
    figures = summary["window-close"]["2"]
    own = SCORES[2]
    assert figures["success_any"] == pytest.approx(own.success_any[1, 1].mean())
    assert figures["return"] == pytest.approx(own.returns[1, 1].mean(), rel=1e-6)
    assert figures["first_success_step"] == pytest.approx(own.first_success[1, 1].mean())
    low, high = figures["interval_95"]["success_any"]
    assert low < figures["success_any"] < high


def test_a_rate_has_wilsons_interval_and_a_return_its_own():
    own, figures = SCORES[2], summarise(of_policy(SCORES, 1), TASKS)["window-close"]["2"]
    goals = own.success_any.shape[2]
    expected = wilson_interval(float(own.success_any[1, 1].mean()), goals)
    assert figures["interval_95"]["success_any"] == pytest.approx(list(expected))
    low, high = figures["interval_95"]["return"]
    assert low < figures["return"] < high
    sure = {0: Episode(*(np.ones((1, 50, 1)) for _ in Episode._fields))}
    low, high = summarise(sure, ("a",))["a"]["0"]["interval_95"]["success_any"]
    assert (round(low, 2), high) == (0.93, 1.0)


def test_draws_of_a_goal_do_not_count_as_goals():
    """The interval is over goals: repeating every draw must not shrink it."""
    one = {0: episode(0, (2, 5, 1))}
    many = {0: Episode(*(np.repeat(x, 10, axis=-1) for x in one[0]))}
    assert_summaries_agree(summarise(one, TASKS), summarise(many, TASKS))


def test_the_table_names_every_task_and_k():
    lines = format_scores(summarise(of_policy(SCORES, 0), TASKS)).splitlines()
    assert [line.split()[:2] for line in lines[1:]] == [[t, k] for t in TASKS for k in "02"]
    success = SCORES[0].success_any[0, 0].mean()
    assert f"{success:.2f}" in lines[1]


def test_faults_of_the_physics_are_told():
    assert "warning" not in format_scores(summarise(of_policy(SCORES, 0), TASKS))
    faults = np.zeros((2, 2, 5, 3), np.int32)
    faults[0, 1, 2, 0] = 3
    sick = SCORES | {2: SCORES[2]._replace(faults=faults)}
    summary = summarise(of_policy(sick, 0), TASKS)
    assert summary["window-close"]["2"]["faults"] == pytest.approx(3 / 15)
    [line] = [x for x in format_scores(summary).splitlines() if x.startswith("warning")]
    assert "window-close 0.2 times" in line and "window-open" not in line


def test_rows_hold_every_figure(tmp_path):
    path = tmp_path / "s.csv"
    with CellTable(path) as table:
        table.add(cell_rows(of_policy(SCORES, 1), TASKS, COMMON))
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS and len(rows) == 2 * 5 * 3 * 2
    for row in rows:
        k, task, goal, draw = (row[name] for name in ("k", "task", "goal", "draw"))
        place = (1, TASKS.index(task), int(goal), int(draw))
        for column, field in FIGURES.items():
            assert np.float32(row[column]) == np.float32(getattr(SCORES[int(k)], field)[place])
        assert (row["run"], row["checkpoint"], row["text"]) == ("runs/a", "20", "")
    wanted = summarise(of_policy(SCORES, 1), TASKS)
    assert_summaries_agree(summarise_rows(rows), wanted)
