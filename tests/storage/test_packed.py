"""Packed policies: the same arrays from one file, wherever it was packed; never wrong data."""

import shutil
import tempfile
import zipfile

import pytest
from checkpoint_fixtures import assert_equal_trees, init_state, make_meta

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.storage import checkpoint, manifest
from cmrl_jax.storage.packed import pack


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with the policies of iterations 3 and 7; do not change it."""
    run = tmp_path_factory.mktemp("run")
    with checkpoint.policy_store(run) as store:
        for step in (3, 7):
            assert store.save({"policy": init_state(step)}, make_meta(step))
    return run


@pytest.fixture
def packed(run, tmp_path):
    """The same run with both packed."""
    for step in (3, 7):
        pack(run / "policy" / str(step), tmp_path / "run" / "policy" / f"{step}.zip")
    return tmp_path / "run"


def read(run, step=None):
    with checkpoint.policy_store(run, read_only=True) as store:
        return store.restore({"policy": init_state()}, step=step), store.steps()


def test_a_packed_policy_is_the_policy(run, packed):
    for step in (3, 7, None):
        (found, meta), steps = read(packed, step)
        (wanted, meta_of_run), _ = read(run, step)
        assert (meta, steps) == (meta_of_run, [3, 7])
        assert_equal_trees(found, wanted)
    assert [path.name for path in sorted(packed.rglob("*")) if path.is_file()] == ["3.zip", "7.zip"]


def test_it_is_one_file_wherever_it_is_packed(run, packed, tmp_path):
    """Nothing in it says where it was: another place or machine gives the same bytes."""
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(run / "policy" / "7", elsewhere / "7")
    for mark in (elsewhere / "7").rglob("commit_success.txt"):
        mark.write_text(f"Checkpoint commit was successful to {mark.parent}")
    pack(elsewhere / "7", elsewhere / "7.zip")
    file = packed / "policy" / "7.zip"
    assert (elsewhere / "7.zip").read_bytes() == file.read_bytes()
    with zipfile.ZipFile(file) as archive:
        for name in archive.namelist():
            assert str(run).encode() not in archive.read(name), name


def test_its_digest_is_that_of_its_files(packed, tmp_path):
    with zipfile.ZipFile(packed / "policy" / "7.zip") as archive:
        archive.extractall(tmp_path / "files")
    digest = checkpoint.policy_digest(packed, 7)
    assert digest == manifest.fingerprint(tmp_path / "files")
    assert digest != checkpoint.policy_digest(packed, 3)


def test_a_folder_is_not_hidden_by_a_packed_one(run, packed):
    shutil.copytree(run / "policy" / "3", packed / "policy" / "3")
    assert read(packed)[1] == [3]
    assert checkpoint.policy_digest(packed, 3) == checkpoint.policy_digest(run, 3)


def test_what_was_unpacked_to_be_read_is_removed(packed, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    read(packed)
    (packed / "policy" / "7.zip").write_bytes(b"")
    with pytest.raises(ConfigError):
        read(packed)
    assert list((tmp_path / "temporary").iterdir()) == []


def test_damage_never_comes_back_as_data(packed):
    file = packed / "policy" / "7.zip"
    sound, wanted = file.read_bytes(), read(packed)[0]
    harms = [sound[: len(sound) // 2], b"", b"no archive"]
    for place in range(0, len(sound), len(sound) // 30):
        harms.append(sound[:place] + bytes([sound[place] ^ 4]) + sound[place + 1 :])
    refused = 0
    for harmed in harms:
        file.write_bytes(harmed)
        try:
            found, meta = read(packed, 7)[0]
        except ConfigError as error:
            refused += 1
            assert "7" in error.cause and "\n" not in error.cause and error.cure
        else:
            assert meta == wanted[1]
            assert_equal_trees(found, wanted[0])
    assert refused > 25
