"""Packed policies: the same arrays from one file, and never wrong ones."""

import shutil
import tempfile
import zipfile

import pytest
from checkpoint_fixtures import assert_equal_trees, init_state, make_meta

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.storage import checkpoint, manifest
from cmrl_jax.storage.packed import pack, read_packed, unpack


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


def refusal(run, step=None):
    with pytest.raises(ConfigError) as raised:
        read(run, step)
    return raised.value.cause, raised.value.cure


def test_a_packed_policy_is_the_policy(run, packed):
    for step in (3, 7, None):
        (found, meta), steps = read(packed, step)
        (wanted, meta_of_run), _ = read(run, step)
        assert (meta, steps) == (meta_of_run, [3, 7])
        assert_equal_trees(found, wanted)
    assert [path.name for path in sorted(packed.rglob("*")) if path.is_file()] == ["3.zip", "7.zip"]


def test_copies_of_one_checkpoint_are_one_file_that_names_no_place(run, packed, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(run / "policy" / "7", elsewhere / "7")
    for mark in (elsewhere / "7").rglob("commit_success.txt"):
        mark.write_text(f"Checkpoint commit was successful to {mark.parent}")
    manifest.write_manifest(elsewhere / "7")
    pack(elsewhere / "7", elsewhere / "7.zip")
    file = packed / "policy" / "7.zip"
    assert (elsewhere / "7.zip").read_bytes() == file.read_bytes()
    assert not any(str(run).encode() in data for data in read_packed(file).values())


def test_a_damaged_checkpoint_is_not_packed(run, tmp_path):
    shutil.copytree(run / "policy" / "7", tmp_path / "7")
    next((tmp_path / "7").rglob("_METADATA")).write_text("{}")
    with pytest.raises(ConfigError, match="is damaged: .*_METADATA is not what was written"):
        pack(tmp_path / "7", tmp_path / "7.zip")
    assert not (tmp_path / "7.zip").exists()


def test_its_digest_is_that_of_its_files(packed, tmp_path):
    unpack(packed / "policy" / "7.zip", tmp_path / "files")
    digest = checkpoint.policy_digest(packed, 7)
    assert digest == manifest.fingerprint(tmp_path / "files")
    assert digest != checkpoint.policy_digest(packed, 3)


def test_a_folder_is_not_hidden_by_a_packed_one(run, packed):
    shutil.copytree(run / "policy" / "3", packed / "policy" / "3")
    assert read(packed)[1] == [3]
    assert checkpoint.policy_digest(packed, 3) == checkpoint.policy_digest(run, 3)


def test_a_damaged_one_is_named_and_leaves_the_others(packed, tmp_path, monkeypatch):
    """Nothing that was unpacked stays, either."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    file = packed / "policy" / "7.zip"
    file.write_bytes(file.read_bytes()[:-30])
    cause, cure = refusal(packed)
    assert cause.startswith(f"checkpoint {file} is damaged: BadZipFile")
    assert cure == "use an older one: --checkpoint 3"
    with pytest.raises(ConfigError, match=r"7\.zip is damaged"):
        checkpoint.policy_digest(packed, 7)
    (found, _), steps = read(packed, 3)
    assert steps == [3, 7]
    assert_equal_trees(found["policy"], init_state(3))
    assert list((tmp_path / "temporary").iterdir()) == []


@pytest.mark.parametrize("name", ["/x", "../x", "a/../../x"])
def test_what_lies_outside_or_was_not_packed_here_is_refused(packed, name):
    file = packed / "policy" / "7.zip"
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr(name, "x")
    assert "lies outside it" in refusal(packed)[0]
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("policy/d", "x")
    assert "it has no sha256.txt" in refusal(packed)[0]


def test_no_flipped_bit_comes_back_as_data(packed, tmp_path):
    """Every byte of what says where the files are, and every hundredth of the files."""
    file = packed / "policy" / "7.zip"
    sound, wanted = file.read_bytes(), read_packed(file)
    directory = sound.index(b"PK\x01\x02")
    places = [*range(0, directory, 100), *range(directory, len(sound))]
    refused = 0
    for n, place in enumerate(places):
        flipped = sound[place] ^ (1 << n % 8)
        file.write_bytes(sound[:place] + bytes([flipped]) + sound[place + 1 :])
        try:
            found = read_packed(file)
        except zipfile.BadZipFile:
            refused += 1
            continue
        if found != wanted:
            shutil.rmtree(tmp_path / "files", ignore_errors=True)
            unpack(file, tmp_path / "files")
            assert manifest.find_damage(tmp_path / "files"), place
            refused += 1
    assert refused > len(places) // 3
