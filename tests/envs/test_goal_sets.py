"""Goal sets against metaworld's own task maker, and their use without metaworld."""

import pickle
import subprocess
import sys
from collections import OrderedDict
from pathlib import Path

import metaworld
import numpy as np
import pytest
from metaworld.env_dict import ALL_V3_ENVIRONMENTS, ML1_args_kwargs

from envs import goal_names, goal_sets
from envs.goal_sets import SEEDS, draw_goals, load_goal_set
from envs.tasks import METAWORLD_TASKS as TASKS
from envs.tasks import REGISTRY
from envs.tasks.specs import SPECS

BOXES = {
    task: (spec.placement_low, spec.placement_high)
    for task, spec in zip(REGISTRY, SPECS, strict=True)
}


def rand_vecs(tasks, name):
    return np.array([pickle.loads(t.data)["rand_vec"] for t in tasks if t.env_name == name])


@pytest.mark.parametrize("task", TASKS)
def test_train_set_is_what_ml1_of_metaworld_trains_on(task):
    benchmark = metaworld.ML1(f"{task}-v3", seed=SEEDS["train"])
    ours = load_goal_set("train", (task,))
    np.testing.assert_array_equal(ours[0], rand_vecs(benchmark.train_tasks, f"{task}-v3"))


@pytest.mark.parametrize("task", TASKS)
def test_heldout_set_redrawn(task):
    np.testing.assert_array_equal(
        load_goal_set("heldout", (task,))[0], draw_goals(task, SEEDS["heldout"])
    )


def test_goals_do_not_depend_on_neighbours():
    """In one joint call of the maker they would: that is why there is one call a task."""
    first, second = "drawer-open-v3", "window-open-v3"
    joint = metaworld._make_tasks(
        OrderedDict({name: ALL_V3_ENVIRONMENTS[name] for name in (first, second)}),
        OrderedDict({name: ML1_args_kwargs[name] for name in (first, second)}),
        {"partially_observable": True},
        seed=0,
    )
    ours = load_goal_set("train", ("window-open", "drawer-open"))
    assert not np.array_equal(rand_vecs(joint, second), ours[0])
    np.testing.assert_array_equal(rand_vecs(joint, first), ours[1])
    np.testing.assert_array_equal(ours, load_goal_set("train", TASKS)[[2, 0]])


@pytest.mark.parametrize("name", SEEDS)
def test_sets_are_complete_distinct_and_inside_the_reset_boxes(name):
    goals = load_goal_set(name, TASKS)
    assert goals.shape == (4, 50, 3) and goals.dtype == np.float64
    for task, places in zip(TASKS, goals, strict=True):
        assert len(np.unique(places, axis=0)) == 50
        low, high = np.array(BOXES[task])
        assert np.all(places >= low) and np.all(places <= high)
        moves = high > low
        assert np.all(np.ptp(places, axis=0)[moves] > 0.8 * (high - low)[moves])


def test_reset_boxes_are_metaworlds():
    for task in TASKS:
        env = ALL_V3_ENVIRONMENTS[f"{task}-v3"]()
        space = env._random_reset_space
        assert space is not None
        np.testing.assert_array_equal([space.low, space.high], BOXES[task])


def test_train_and_heldout_share_no_goal():
    for train, heldout in zip(load_goal_set("train"), load_goal_set("heldout"), strict=True):
        together = np.concatenate([train, heldout])
        assert len(np.unique(together, axis=0)) == 100


def test_drawing_leaves_numpys_global_stream_alone():
    np.random.seed(5)  # noqa: NPY002 - metaworld's maker uses the global stream
    expected = np.random.random()  # noqa: NPY002
    np.random.seed(5)  # noqa: NPY002
    draw_goals("drawer-open", 3)
    assert np.random.random() == expected  # noqa: NPY002


def test_fresh_set_is_drawn_once_then_cached(tmp_path, monkeypatch):
    monkeypatch.setenv("CMRL_JAX_CACHE", str(tmp_path))
    drawn = load_goal_set("fresh:7", ("window-close",))
    np.testing.assert_array_equal(drawn[0], draw_goals("window-close", 7))
    monkeypatch.setattr(goal_sets, "draw_goals", lambda *_: pytest.fail("not read from the cache"))
    np.testing.assert_array_equal(load_goal_set("fresh:7", ("window-close",)), drawn)


@pytest.mark.parametrize("name", ["fresh:0", "fresh:1000", "fresh:007", "fresh:00"])
def test_a_set_has_one_name(name):
    """Evaluations tell their figures apart by it, and `fresh:0` has the goals of `train`."""
    only = {"fresh:1000": "heldout", "fresh:007": "fresh:7"}.get(name, "train")
    with pytest.raises(ValueError, match=f"'{name}' is the goal set '{only}'\ncall it {only}$"):
        load_goal_set(name, ("drawer-close",))


def test_a_seed_has_one_set():
    names = {seed: goal_names.name_of(seed) for seed in (0, 7, 1000, goal_names.LARGEST_SEED)}
    assert list(names.values()) == ["train", "fresh:7", "heldout", "fresh:2147483647"]
    assert {goal_names.seed_of(name): name for name in names.values()} == names


def homeless(_):
    raise RuntimeError("Could not determine home directory.")


@pytest.mark.parametrize("home", ["no home", "a cache that cannot be looked at"])
def test_a_set_can_be_drawn_without_a_cache(home, monkeypatch):
    if home == "no home":
        monkeypatch.delenv("CMRL_JAX_CACHE", raising=False)
        monkeypatch.setattr(Path, "expanduser", homeless)
    else:
        monkeypatch.setenv("CMRL_JAX_CACHE", "x" * 300)
    assert load_goal_set("fresh:8", ("drawer-open",)).shape == (1, 50, 3)


def test_unwritable_cache_does_not_stop_a_run(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("a file where the cache directory should be")
    assert load_goal_set("fresh:8", ("drawer-open",), blocked).shape == (1, 50, 3)


def test_packaged_file_is_made_byte_for_byte(tmp_path):
    goal_sets.main(["--out", str(tmp_path / "again.npz")])
    assert (tmp_path / "again.npz").read_bytes() == goal_sets._PACKAGED.read_bytes()


def test_packaged_sets_need_no_metaworld_and_no_simulator():
    code = (
        "import sys; from envs.goal_sets import load_goal_set; load_goal_set('heldout');"
        "bad = {'metaworld', 'mujoco', 'jax', 'gymnasium'} & set(sys.modules);"
        "sys.exit(', '.join(bad) or 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize(
    ("name", "tasks", "cause"),
    [
        ("held-out", TASKS, "did you mean 'heldout'"),
        ("fresh", TASKS, "'fresh' is no goal set"),
        ("fresh:", TASKS, "no goal set"),
        ("fresh:-1", TASKS, "no goal set"),
        ("fresh:2147483648", TASKS, "too large"),
        ("train", ("drawer-opn",), "did you mean 'drawer-open'"),
    ],
)
def test_mistakes_name_cause_and_cure(name, tasks, cause):
    with pytest.raises(ValueError, match=cause) as error:
        load_goal_set(name, tasks)
    assert len(str(error.value).splitlines()) == 2


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", None])
def test_corrupt_cache_names_the_file(tmp_path, content):
    path = tmp_path / "goals" / "drawer-open-9.npz"
    path.parent.mkdir()
    if content is None:
        np.savez(path, goals=np.zeros((3, 3)))
    else:
        path.write_bytes(content)
    with pytest.raises(ValueError, match="drawer-open-9.npz") as error:
        load_goal_set("fresh:9", ("drawer-open",), tmp_path)
    assert len(str(error.value).splitlines()) == 2
