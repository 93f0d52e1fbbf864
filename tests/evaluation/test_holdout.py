"""Leave one task out: what is held out is looked at, and changes nothing that is trained."""

import pytest
from run_helpers import checkpoint_leaves, native, rows_of, smoke

TASKS = ("drawer-open", "drawer-close", "window-open", "window-close")


def train_columns(run):
    return [{c: text for c, text in row.items() if "eval/" not in c} for row in rows_of(run)]


def assert_same_training(run, other):
    assert train_columns(run) == train_columns(other)
    assert any(column.startswith("train/") for column in train_columns(run)[0])
    leaves, expected = (checkpoint_leaves(r)[0] for r in (run, other))
    assert leaves.keys() == expected.keys()
    for path, leaf in expected.items():
        assert leaf.tobytes() == leaves[path].tobytes(), path


def evaluated(run):
    return {c.split("/")[1] for row in rows_of(run) for c in row if c.startswith("eval/")}


def test_training_is_the_same_with_nothing_held_out(undisturbed, tmp_path):
    run = tmp_path / "run"
    assert smoke(run, *native(), "--tasks.test", "") == 0
    assert evaluated(run) == set(TASKS[:3]) and evaluated(undisturbed) == set(TASKS)
    assert_same_training(run, undisturbed)


@pytest.mark.slow
def test_training_is_the_same_whatever_is_held_out(tmp_path):
    """With the test above, each of the four tasks is held out once. Evaluated every iteration."""
    sizes = ("--collect.lanes", "4", "--env.horizon", "10", "--train.env_steps", "80")
    sizes += ("--encoder.aux", "none")  # a single task has nothing to be told from
    looks = ("--eval.goals", "1", "--eval.final_goals", "1", "--eval.k", "0", "--eval.final_k", "0")
    for name, held_out in (("one", TASKS[:1]), ("two", TASKS[1:3])):
        words = ("--tasks.train", "window-close", "--tasks.test", ",".join(held_out))
        assert smoke(tmp_path / name, *native(), *sizes, *looks, *words) == 0
        assert evaluated(tmp_path / name) == {"window-close", *held_out}
    assert_same_training(tmp_path / "one", tmp_path / "two")
