"""Checkpoints: what is saved comes back bit for bit; every fault is one cause and one cure."""

import dataclasses
import json
import logging
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checkpoint_fixtures import (
    ABSTRACT,
    VERSIONS,
    assert_equal_trees,
    cause_and_cure,
    init_state,
    make_meta,
    restore,
    save_steps,
    unlist,
)

from cmrl_jax.config.files import to_dict
from cmrl_jax.config.schema import Config, ConfigError
from cmrl_jax.nn.normalizers import init_obs_stats, init_return_stats
from cmrl_jax.storage import checkpoint


def test_everything_comes_back_bit_for_bit(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = Path("runs") / "relative"
    save_steps(run, 0, 7)
    trees, meta = restore(run, config=Config())
    assert_equal_trees(trees["learner"], init_state(7))
    assert trees["replay"] is None and trees["context"] is None
    assert trees["learner"].lanes == 3
    assert meta == json.loads(json.dumps(make_meta(7)))
    # The restored key draws what the saved one would have drawn.
    drawn = jax.random.normal(trees["learner"].key[1], (3,))
    np.testing.assert_array_equal(drawn, jax.random.normal(init_state(7).key[1], (3,)))
    assert_equal_trees(restore(run, step=0)[0]["learner"], init_state(0))


def test_rings_come_back_beside_the_learner(tmp_path):
    rings = {"replay": {"rows": jnp.ones((3, 8, 2))}, "context": {"rows": jnp.zeros((3, 4, 2))}}
    with checkpoint.full_store(tmp_path) as store:
        store.save({"learner": init_state(), **rings}, make_meta(0))
        trees, _ = store.restore(ABSTRACT | jax.eval_shape(lambda: rings))
    assert_equal_trees(trees, {"learner": init_state(), **rings})


def test_a_saved_buffer_may_be_donated_at_once(tmp_path):
    """Nothing may still read the buffer when the next iteration writes into it."""
    rows = jax.random.normal(jax.random.key(0), (3, 50_000, 20))
    expected = np.array(rows, copy=True)
    overwrite = jax.jit(lambda x: x * 0.0, donate_argnums=0)
    with checkpoint.full_store(tmp_path) as store:
        store.save({"learner": init_state(), "replay": rows, "context": None}, make_meta(0))
        jax.block_until_ready(overwrite(rows))
        abstract = ABSTRACT | {"replay": jax.ShapeDtypeStruct(expected.shape, jnp.float32)}
        trees, _ = store.restore(abstract)
    np.testing.assert_array_equal(trees["replay"], expected)


def test_the_newest_are_kept_and_policies_all(tmp_path):
    save_steps(tmp_path, 1, 2, 5, 9, keep=2)
    with checkpoint.full_store(tmp_path, read_only=True) as store:
        assert store.steps() == [5, 9]
    with checkpoint.policy_store(tmp_path) as store:
        for step in (1, 2, 5, 9):
            store.save({"policy": {"actor": jnp.full(2, step)}}, make_meta(step))
    with checkpoint.policy_store(tmp_path, read_only=True) as store:
        assert store.steps() == [1, 2, 5, 9]
        abstract = {"policy": {"actor": jax.ShapeDtypeStruct((2,), jnp.int32)}}
        trees, meta = store.restore(abstract, step=2)
        np.testing.assert_array_equal(trees["policy"]["actor"], [2, 2])
        assert (meta["iteration"], store.read_meta()["iteration"]) == (2, 9)


def test_steps_only_go_forward(tmp_path):
    trees = {"learner": init_state(), "replay": None, "context": None}
    with checkpoint.full_store(tmp_path) as store:
        assert store.save(trees, make_meta(4))
        assert not store.save(trees, make_meta(4))
        with pytest.raises(ValueError, match="3 comes after 4"):
            store.save(trees, make_meta(3))


def test_items_and_meta_are_the_stores_own(tmp_path):
    trees = {"learner": init_state(), "replay": None, "context": None}
    with checkpoint.full_store(tmp_path) as store:
        with pytest.raises(ValueError, match="learner"):
            store.save({"learner": init_state()}, make_meta(0))
        with pytest.raises(ValueError, match="more"):
            store.save(trees, make_meta(0, more=1))
        with pytest.raises(TypeError, match="JSON"):
            store.save(trees, make_meta(0, env_steps=np.int64(1)))
        assert store.steps() == []


def test_a_save_cut_short_leaves_the_one_before_and_is_swept(tmp_path):
    save_steps(tmp_path, 1, 2)
    cut = tmp_path / "ckpt" / "2.orbax-checkpoint-tmp"  # what kill -9 in a save was seen to leave
    (tmp_path / "ckpt" / "2").rename(cut)
    (cut / "learner" / "_METADATA").unlink()
    trees, meta = restore(tmp_path)
    assert meta["iteration"] == 1
    assert_equal_trees(trees["learner"], init_state(1))
    assert cut.exists(), "a reader must not touch a save that may be going on"
    save_steps(tmp_path, 3)  # another step, which does not need that name
    assert not cut.exists()
    assert_equal_trees(restore(tmp_path)[0]["learner"], init_state(3))


def test_a_long_complaint_is_cut_to_one_line(tmp_path, monkeypatch):
    save_steps(tmp_path, 1)

    def complain(*_: object, **__: object):
        raise RuntimeError("first line" + "." * 900 + "\nsecond line")

    with checkpoint.full_store(tmp_path, read_only=True) as store:
        monkeypatch.setattr(store._manager, "restore", complain)
        with pytest.raises(ConfigError) as raised:
            store.read_meta()
    cause = raised.value.cause
    assert "first line" in cause and "\n" not in cause and len(cause) < 600


def test_nothing_to_restore(tmp_path):
    cause, cure = cause_and_cure(tmp_path)
    assert cause == f"no checkpoint in {tmp_path / 'ckpt'}" and "--run" in cure
    assert not (tmp_path / "ckpt").exists(), "a reader must not make directories"
    (tmp_path / "ckpt").mkdir()
    assert cause_and_cure(tmp_path)[0] == cause
    save_steps(tmp_path, 3, 6)
    assert "there are: 3, 6" in cause_and_cure(tmp_path, step=4)[1]


def test_a_meta_record_of_another_program_is_refused(tmp_path):
    save_steps(tmp_path, 1)
    path = tmp_path / "ckpt" / "1" / "meta" / "metadata"
    path.write_text(json.dumps({"config": {}}), encoding="utf-8")
    unlist(tmp_path, 1)
    assert "other fields" in cause_and_cure(tmp_path)[0]


def test_a_changed_setting_is_refused_by_name_before_any_array(tmp_path):
    save_steps(tmp_path, 1)
    shutil.rmtree(tmp_path / "ckpt" / "1" / "learner")
    unlist(tmp_path, 1)
    changed = dataclasses.replace(Config(), seed=5)
    cause, cure = cause_and_cure(tmp_path, config=changed)
    assert "seed: 0 -> 5" in cause and "config.yaml" in cure


def test_another_origin_of_what_the_policy_saw_is_refused_by_name(tmp_path):
    """Whatever config.yaml says: the checkpoint has a record of its own."""
    for mode in ("metaworld", "canonical"):
        record = to_dict(Config())
        record["env"]["obs_mode"] = mode
        del record["env"]["origin"]  # as runs of old
        with checkpoint.policy_store(tmp_path / mode) as store:
            store.save({"policy": {"actor": jnp.ones(2)}}, make_meta(1, config=record))
    abstract = {"policy": {"actor": jax.ShapeDtypeStruct((2,), jnp.float32)}}
    with checkpoint.policy_store(tmp_path / "metaworld", read_only=True) as store:
        store.restore(abstract)
    with checkpoint.policy_store(tmp_path / "canonical", read_only=True) as store:
        with pytest.raises(ConfigError, match="env.origin: reset observation -> settled"):
            store.restore(abstract)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"count": jax.ShapeDtypeStruct((3,), jnp.int32)}, "count is int32[] there, int32[3] here"),
        ({"count": jax.ShapeDtypeStruct((), jnp.float32)}, "int32[] there, float32[] here"),
        ({"absent": jax.ShapeDtypeStruct((3,), jnp.int32)}, "absent is absent there"),
        ({"flags": None}, "flags is bool[2] there, absent here"),
    ],
)
def test_an_array_that_does_not_fit_is_named(tmp_path, change, message):
    save_steps(tmp_path, 1)
    abstract = ABSTRACT | {"learner": dataclasses.replace(ABSTRACT["learner"], **change)}
    with checkpoint.full_store(tmp_path, read_only=True) as store:
        with pytest.raises(ConfigError) as raised:
            store.restore(abstract)
    assert message in raised.value.cause and "version" in raised.value.cure


def old_statistics(values: np.ndarray) -> dict[str, dict[str, jax.Array]]:
    """Of values (step, 3), as checkpoints held them that summed squared deviations."""
    single = lambda x: jnp.asarray(x, jnp.float32)
    total = np.square(values - values.mean(0)).sum(0)
    mean, std, count = single(values.mean(0)), single(values.std(0)), len(values)
    halves = {"count/hi": jnp.uint32(0), "count/lo": jnp.uint32(count)}
    of_obs = {"mean": mean, "std": std, "std_eps": single(0.0), "summed_variance": single(total)}
    of_returns = {"mean": mean, "count": jnp.full(3, count, jnp.float32), "m2": single(total)}
    kept = {"returns": jnp.ones((3, 2)), "largest": single(np.abs(values).max(0))}
    return {"obs_stats": of_obs | halves, "return_stats": of_returns | kept}


def test_statistics_of_an_old_checkpoint_are_brought_up(tmp_path):
    """Sums become the means that they stand for; a run goes on from them, a policy acts by them."""
    values = np.random.default_rng(0).normal(5.0, [0.1, 1.0, 10.0], (1000, 3))
    old = old_statistics(values)
    current = {"obs_stats": init_obs_stats(3), "return_stats": init_return_stats(3, 2)}
    with checkpoint.full_store(tmp_path) as store:
        store.save({"learner": {"state": old}, "replay": None, "context": None}, make_meta(1))
        abstract = jax.eval_shape(lambda: {"state": current})
        trees, _ = store.restore({"learner": abstract, "replay": None, "context": None})
    with checkpoint.policy_store(tmp_path) as store:
        store.save({"policy": {"obs_stats": old["obs_stats"]}}, make_meta(1))
        abstract = jax.eval_shape(lambda: {"obs_stats": current["obs_stats"]})
        policy, _ = store.restore({"policy": abstract})
    state = trees["learner"]["state"]
    assert jax.tree.structure(state) == jax.tree.structure(current)
    assert_equal_trees(policy["policy"]["obs_stats"], state["obs_stats"])
    for stats in state.values():
        assert int(stats.moments.count) == 1000
        np.testing.assert_allclose(stats.moments.mean.value, values.mean(0), rtol=1e-6)
        np.testing.assert_allclose(stats.moments.variance.value, values.var(0), rtol=1e-6)
        assert not stats.moments.mean.rest.any() and not stats.moments.variance.rest.any()
    np.testing.assert_array_equal(state["obs_stats"].std, old["obs_stats"]["std"])
    for name in ("returns", "largest"):
        np.testing.assert_array_equal(
            getattr(state["return_stats"], name), old["return_stats"][name]
        )


def test_old_statistics_of_another_size_are_refused(tmp_path):
    old = {"obs_stats": old_statistics(np.zeros((2, 3)))["obs_stats"]}
    with checkpoint.policy_store(tmp_path) as store:
        store.save({"policy": old}, make_meta(1))
        abstract = jax.eval_shape(lambda: {"obs_stats": init_obs_stats(4)})
        with pytest.raises(ConfigError, match=r"mean is float32\[3\] there, float32\[4\] here"):
            store.restore({"policy": abstract})


def test_what_an_older_policy_lacks_is_nan(tmp_path):
    """But only what a version has added: anything else that is absent is refused."""
    with checkpoint.policy_store(tmp_path) as store:
        store.save({"policy": {"params": {"actor_params": jnp.ones(2)}}}, make_meta(1))
        shapes = {"actor_params": jnp.ones(2), "task_z": jnp.ones((3, 2))}
        found, _ = store.restore({"policy": {"params": shapes}})
        params = found["policy"]["params"]
        assert np.isnan(params["task_z"]).all() and params["task_z"].shape == (3, 2)
        assert_equal_trees(params["actor_params"], jnp.ones(2))
        with pytest.raises(ConfigError, match=r"more is absent there, float32\[2\] here"):
            store.restore({"policy": {"params": shapes | {"more": jnp.ones(2)}}})


def test_other_package_versions_warn_in_one_line(tmp_path, capsys):
    save_steps(tmp_path, 1)
    restore(tmp_path, versions=VERSIONS)
    assert capsys.readouterr() == ("", "")
    restore(tmp_path, versions={"jax": "0.13.0", "flax": "0.12.12"})
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1
    assert "jax 0.12.0 (here 0.13.0)" in err and "flax" not in err


def test_orbax_is_quiet_and_other_logging_is_not(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    save_steps(tmp_path, 1)
    restore(tmp_path)
    assert [record for record in caplog.records if record.name == "absl"] == []
    logging.getLogger("absl").warning("still heard")
    assert [r.message for r in caplog.records if r.name == "absl"] == ["still heard"]


def test_a_directory_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "ckpt").write_text("a file, where the directory should be")
    with pytest.raises(ConfigError) as raised:
        checkpoint.full_store(tmp_path)
    assert "ckpt" in raised.value.cause and "--run" in raised.value.cure
