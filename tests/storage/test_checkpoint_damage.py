"""Damaged checkpoints and failed saves: never wrong data, and the step before survives."""

import dataclasses
import errno
import json
import resource
import shutil
import subprocess
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

from cmrl_jax.config.schema import Config, ConfigError
from cmrl_jax.storage import checkpoint, manifest


def flip_a_bit(path, byte):
    data = bytearray(path.read_bytes())
    data[byte % len(data)] ^= 4
    path.write_bytes(data)


def halve(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


HARM = {
    "first byte flipped": lambda path: flip_a_bit(path, 0),
    "middle byte flipped": lambda path: flip_a_bit(path, path.stat().st_size // 2),
    "truncated": halve,
    "emptied": lambda path: path.write_bytes(b""),
    "missing": Path.unlink,
}


@pytest.mark.parametrize("harm", HARM)
def test_damage_to_any_file_never_comes_back_as_data(tmp_path, capfd, harm):
    """Each file in turn: the step is refused and the one before it used, or it is read rightly."""
    rows = jax.random.normal(jax.random.key(0), (3, 500, 2))  # numbers that do not compress
    with checkpoint.full_store(tmp_path / "sound") as store:
        for step in (1, 2):
            trees = {"learner": init_state(step), "replay": step * rows, "context": None}
            store.save(trees, make_meta(step))
    abstract = ABSTRACT | {"replay": rows}
    files = sorted(p for p in (tmp_path / "sound" / "ckpt" / "2").rglob("*") if p.is_file())
    refused = set()
    for number, path in enumerate(files):
        run = tmp_path / str(number)
        shutil.copytree(tmp_path / "sound", run)
        HARM[harm](run / path.relative_to(tmp_path / "sound"))
        with checkpoint.full_store(run) as store:
            trees, meta = store.resume(abstract, Config(), VERSIONS)
        step = meta["iteration"]
        assert meta == json.loads(json.dumps(make_meta(step)))
        assert_equal_trees(trees["learner"], init_state(step))
        np.testing.assert_array_equal(trees["replay"], step * rows)
        out, err = capfd.readouterr()
        assert out == ""
        lines = err.splitlines()
        if step == 1:
            refused.add(str(path.relative_to(tmp_path / "sound" / "ckpt" / "2")))
            [line] = lines
            assert line.startswith(f"warning: checkpoint {run / 'ckpt' / '2'} is damaged: ")
            assert line.endswith("; kept as damaged-2, going on from 1")
            assert sorted(p.name for p in (run / "ckpt").iterdir()) == ["1", "damaged-2"]
        else:
            assert lines == []
    names = {str(path.relative_to(tmp_path / "sound" / "ckpt" / "2")) for path in files}
    # A save that was killed before its last file is a whole one.
    assert refused == (names - {"sha256.txt"} if harm == "missing" else names)


def test_a_step_behind_a_damaged_one_is_saved_again(tmp_path, capsys):
    save_steps(tmp_path, 1, 2, 3)
    for step in (2, 3):
        (tmp_path / "ckpt" / str(step) / "meta" / "metadata").unlink()
    with checkpoint.full_store(tmp_path) as store:
        assert store.resume(ABSTRACT, Config(), VERSIONS)[1]["iteration"] == 1
        assert len(capsys.readouterr().err.splitlines()) == 2
        trees = {"learner": init_state(2), "replay": None, "context": None}
        assert store.save(trees, make_meta(2))
    save_steps(tmp_path, 3)
    (tmp_path / "ckpt" / "3" / "meta" / "metadata").unlink()
    with checkpoint.full_store(tmp_path) as store:
        assert store.resume(ABSTRACT, Config(), VERSIONS)[1]["iteration"] == 2
    kept = sorted(p.name for p in (tmp_path / "ckpt").iterdir())
    assert kept == ["1", "2", "damaged-2", "damaged-3", "damaged-3-1"]


def test_the_list_of_files_is_one_that_sha256sum_reads(tmp_path):
    save_steps(tmp_path, 1)
    step = tmp_path / "ckpt" / "1"
    command = ["sha256sum", "--check", "--strict", "--quiet", manifest.NAME]
    assert subprocess.run(command, cwd=step, capture_output=True).returncode == 0
    flip_a_bit(step / "meta" / "metadata", 0)
    assert b"meta/metadata: FAILED" in subprocess.run(command, cwd=step, capture_output=True).stdout


# tensorstore's other reads fail too, after orbax has closed their event loop; only a message.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("victim", ["meta", "learner/_METADATA", "learner/manifest", "learner"])
def test_damage_that_no_list_tells_of_is_found_by_reading(tmp_path, victim):
    save_steps(tmp_path, 1, 2)
    step = tmp_path / "ckpt" / "2"
    unlist(tmp_path, 2)
    if victim == "learner/manifest":
        for path in step.rglob("manifest.ocdbt"):
            halve(path)
    elif victim == "meta":
        (step / "meta" / "metadata").write_text("{", encoding="utf-8")
    elif victim == "learner":
        shutil.rmtree(step / "learner")
    else:
        (step / victim).unlink()
    cause, cure = cause_and_cure(tmp_path)
    assert cause.startswith(f"checkpoint {step} is damaged: ") and "\n" not in cause
    assert cure == "resume the run, which goes on from 1 then"
    with checkpoint.full_store(tmp_path) as store:
        assert store.resume(ABSTRACT, Config(), VERSIONS)[1]["iteration"] == 1


def test_a_reader_of_a_damaged_step_is_told_of_an_older_one(tmp_path):
    """No silent change of what is scored: who asks for the newest policy gets that or an error."""
    save_steps(tmp_path, 1, 2)
    shutil.rmtree(tmp_path / "ckpt" / "2" / "meta")
    cause, cure = cause_and_cure(tmp_path)
    path = tmp_path / "ckpt" / "2"
    assert cause == f"checkpoint {path} is damaged: meta/commit_success.txt is missing"
    assert cure == "resume the run, which goes on from 1 then"
    assert restore(tmp_path, step=1)[1]["iteration"] == 1
    shutil.rmtree(tmp_path / "ckpt" / "1" / "meta")
    assert cause_and_cure(tmp_path, step=1)[1] == "start a new run"
    with checkpoint.full_store(tmp_path) as store:
        with pytest.raises(ConfigError, match="ckpt/2 is damaged") as raised:
            store.resume(ABSTRACT, Config(), {})
    assert raised.value.cure == f"put {tmp_path / 'ckpt'} back from a copy, or start a new run"
    assert sorted(p.name for p in (tmp_path / "ckpt").iterdir()) == ["1", "2"], "nothing to go on"


def test_a_step_that_was_being_deleted_is_swept(tmp_path):
    save_steps(tmp_path, 1, 2, 3)
    (tmp_path / "ckpt" / "1" / "learner" / "_METADATA").unlink()
    with checkpoint.full_store(tmp_path, keep=2) as store:
        assert store.resume(ABSTRACT, Config(), VERSIONS)[1]["iteration"] == 3
        assert store.steps() == [2, 3]
    assert sorted(p.name for p in (tmp_path / "ckpt").iterdir()) == ["2", "3"]


def test_fewer_are_kept_only_after_one_was_found_sound(tmp_path):
    save_steps(tmp_path, 1, 2)
    (tmp_path / "ckpt" / "2" / "meta" / "metadata").unlink()
    with checkpoint.full_store(tmp_path, keep=1) as store:
        assert store.resume(ABSTRACT, Config(), VERSIONS)[1]["iteration"] == 1


@pytest.mark.parametrize(
    "error", [MemoryError(), OSError(errno.EIO, "input/output"), jax.errors.JaxRuntimeError("full")]
)
def test_a_machine_that_fails_does_not_make_a_checkpoint_damaged(tmp_path, monkeypatch, error):
    def fail(*_: object, **__: object):
        raise error

    save_steps(tmp_path, 1, 2)
    with checkpoint.full_store(tmp_path) as store:
        monkeypatch.setattr(store._manager, "restore", fail)
        with pytest.raises(type(error)):
            store.resume(ABSTRACT, Config(), VERSIONS)
    assert sorted(p.name for p in (tmp_path / "ckpt").iterdir()) == ["1", "2"]


def test_an_older_policy_is_offered(tmp_path):
    with checkpoint.policy_store(tmp_path) as store:
        for step in (1, 2):
            store.save({"policy": {"actor": jnp.ones(2)}}, make_meta(step))
    (tmp_path / "policy" / "2" / "meta" / "metadata").unlink()
    with checkpoint.policy_store(tmp_path, read_only=True) as store:
        with pytest.raises(ConfigError) as raised:
            store.restore({"policy": {"actor": jax.ShapeDtypeStruct((2,), jnp.float32)}})
    assert raised.value.cure == "use an older one: --checkpoint 1"


def test_a_step_without_its_list_is_read_and_then_listed(tmp_path):
    save_steps(tmp_path, 1)
    unlist(tmp_path, 1)
    with checkpoint.full_store(tmp_path) as store:
        assert store.resume(ABSTRACT, Config(), VERSIONS)[1]["iteration"] == 1
    flip_a_bit(tmp_path / "ckpt" / "1" / "meta" / "metadata", 0)
    assert "meta/metadata is not what was written" in cause_and_cure(tmp_path)[0]


def test_a_policy_ahead_of_its_run_is_dropped(tmp_path):
    with checkpoint.policy_store(tmp_path) as store:
        for step in (1, 2, 5):
            store.save({"policy": {"actor": jnp.full(2, step)}}, make_meta(step))
        store.drop_after(2)
        assert store.steps() == [1, 2]
        assert store.save({"policy": {"actor": jnp.full(2, 3)}}, make_meta(3))


def test_numbers_that_are_not_finite_are_not_saved(tmp_path):
    save_steps(tmp_path, 1)
    for bad in (np.nan, np.inf):
        state = dataclasses.replace(init_state(2), params={"w": jnp.array([0.0, bad])})
        with checkpoint.full_store(tmp_path) as store:
            with pytest.raises(ConfigError) as raised:
                store.save({"learner": state, "replay": None, "context": None}, make_meta(2))
        assert raised.value.cause == "iteration 2 is not saved: learner/params/w is not finite"
        assert str(tmp_path / "ckpt") in raised.value.cure
    assert [p.name for p in (tmp_path / "ckpt").iterdir()] == ["1"]


@pytest.mark.parametrize("keep", [1, 2])
def test_a_disk_that_fills_up_during_a_save_leaves_the_step_before(tmp_path, capfd, keep):
    save_steps(tmp_path, 1, keep=keep)
    noise = jax.random.normal(jax.random.key(0), (50_000,))  # 200 KB that do not compress
    trees = {"learner": init_state(2), "replay": noise, "context": None}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with checkpoint.full_store(tmp_path, keep) as store:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
        try:
            with pytest.raises(OSError) as raised:
                store.save(trees, make_meta(2))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert raised.value.errno == errno.EFBIG
        assert store.steps() == [1]
        assert_equal_trees(restore(tmp_path)[0]["learner"], init_state(1))
    assert capfd.readouterr() == ("", "")  # the caller has a line of its own for it
    save_steps(tmp_path, 2)
    left = sorted(p.name for p in (tmp_path / "ckpt").iterdir())
    assert left == ["1", "2"], "what the failed save left is swept"
    assert_equal_trees(restore(tmp_path)[0]["learner"], init_state(2))
