"""Several seeds in one program: each leaves what it leaves when it is trained alone.

Not to the last bit: a product of matrices for two seeds adds up in another order than one for each.
"""

import json
import shutil
import signal

import numpy as np
import pytest
from run_helpers import native, rows_of, run_and_signal, smoke, smoke_words, start

import cmrl_jax as cj
from cmrl_jax.cli.main import main
from cmrl_jax.storage.checkpoint import full_store
from cmrl_jax.training import trainer
from cmrl_jax.training.run import Run

FLAGS = native(3)


@pytest.fixture(scope="module")
def together(tmp_path_factory):
    """A run of seeds 0 and 1 in one program."""
    run = tmp_path_factory.mktemp("seeds") / "run"
    assert smoke(run, *FLAGS, "--seeds", "2") == 0
    return run


@pytest.fixture(scope="module")
def left(tmp_path_factory):
    """The same, stopped after its second iteration."""
    run = tmp_path_factory.mktemp("left") / "run"
    assert smoke(run, *native(2), "--seeds", "2") == 0
    return run


def assert_close(rows, others):
    assert len(rows) == len(others) > 0
    for row, other in zip(rows, others, strict=True):
        assert row.keys() == other.keys()
        for name, text in row.items():
            assert (text == "") == (other[name] == ""), name
            if text:
                found, expected = float(text), float(other[name])
                np.testing.assert_allclose(found, expected, 1e-5, 1e-5, err_msg=name)


@pytest.mark.parametrize("seed", [0, 1])
def test_each_seed_is_its_run_alone(together, tmp_path, seed):
    alone = tmp_path / "alone"
    assert smoke(alone, *FLAGS, "--seed", str(seed)) == 0
    run = together / f"seed{seed}"
    assert_close(rows_of(run), rows_of(alone))
    page = {"report.html"}  # of all seeds it lies beside them
    assert {p.name for p in alone.iterdir()} - page == {p.name for p in run.iterdir()}
    assert {p.name for p in together.iterdir()} >= page
    assert cj.load_config(run / "config.yaml") == cj.load_config(alone / "config.yaml")
    ours, theirs = (json.loads((x / "eval.json").read_text())["tasks"] for x in (run, alone))
    for task, by_k in theirs.items():
        for k, figures in by_k.items():
            assert ours[task][k]["return"] == pytest.approx(figures["return"], rel=1e-3)


def test_seeds_are_resumed_bit_for_bit(together, left, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(left, run)
    assert main(["--run", str(run), "--resume", "--train.env_steps", "1800"]) == 0
    for seed in ("seed0", "seed1"):
        assert training_of(run / seed) == training_of(together / seed)


def test_a_seed_that_was_killed_before_its_save_takes_the_others_back(together, left, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(left, run)
    shutil.rmtree(run / "seed1" / "ckpt" / "2")
    config = cj.load_config(run / "seed0" / "config.yaml", {"train.env_steps": 1800})
    first, second = cj.train(config, run, seeds=2, resume=True, loggers=lambda config: [])
    assert first.iteration == second.iteration == 3 and first.is_finished
    for seed in ("seed0", "seed1"):
        assert training_of(run / seed) == training_of(together / seed)
    with full_store(run / "seed0", read_only=True) as store:
        assert store.steps() == [2, 3]


def test_one_of_them_goes_on_alone(together, left, tmp_path):
    run = tmp_path / "seed1"
    shutil.copytree(left / "seed1", run)
    assert main(["--run", str(run), "--resume", "--train.env_steps", "1800"]) == 0
    assert_close(training_rows(run), training_rows(together / "seed1"))


def stopped(capsys, *words):
    """Cause and cure of a command that had begun to speak."""
    capsys.readouterr()
    assert main(list(words)) == 2
    cause, cure = capsys.readouterr().err.splitlines()
    return cause.removeprefix("error: "), cure


def test_a_seed_that_went_on_alone_is_not_taken_back(left, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(left, run)
    assert main(["--run", str(run / "seed1"), "--resume", "--train.env_steps", "1800"]) == 0
    before = rows_of(run / "seed1")
    cause, cure = stopped(capsys, "--run", str(run), "--resume", "--train.env_steps", "2400")
    assert "has done 2 iterations, another seed 3" in cause and "seedN" in cure
    assert rows_of(run / "seed1") == before
    with full_store(run / "seed1", read_only=True) as store:
        assert store.steps()[-1] == 3


def test_one_that_diverges_stops_all_and_loses_nothing_of_the_others(
    together, left, tmp_path, capsys, monkeypatch
):
    run, healthy = tmp_path / "run", Run.check_health
    shutil.copytree(left, run)

    def check(self, row):
        healthy(self, row)
        if self.config.seed == 1:
            raise cj.ConfigError("seed 1: every gradient was non-finite", "lower sac.lr")

    monkeypatch.setattr(Run, "check_health", check)
    cause, cure = stopped(capsys, "--run", str(run), "--resume", "--train.env_steps", "1800")
    assert cause.startswith("seed 1: ") and "--run DIR/seedN --resume" in cure
    assert training_rows(run / "seed0") == training_rows(together / "seed0")
    saved = []
    for seed in ("seed0", "seed1"):
        with full_store(run / seed, read_only=True) as store:
            saved.append(store.steps()[-1])
    assert saved == [3, 2]


def training_rows(run):
    """The rows without evaluations, which are due when the schedule says so."""
    is_training = lambda name: not name.startswith("eval/")
    return [{n: t for n, t in row.items() if is_training(n)} for row in rows_of(run)]


def training_of(run):
    return training_rows(run), json.loads((run / "eval.json").read_text())["tasks"]


def test_too_many_for_the_memory_are_refused_with_the_number_that_fits(
    together, tmp_path, refused, monkeypatch
):
    with full_store(together / "seed0", read_only=True) as store:
        size = sum(f.stat().st_size for f in (store.directory / "3").rglob("*") if f.is_file())
    monkeypatch.setattr(trainer, "free_bytes", lambda: 40 * size)
    run = tmp_path / "run"
    cause, cure = refused(*smoke_words(run, *FLAGS, "--seeds", "500"))
    assert "500 seeds of" in cause and "--seeds" in cure
    fits = int(cure.split("--seeds ")[1])
    assert 1 < fits < 500
    assert not list(run.glob("seed*/config.yaml"))  # the same command can be given again


def test_mistakes_are_refused_in_one_line(together, left, tmp_path, refused):
    words = smoke_words(tmp_path / "run", *FLAGS)
    assert "--seeds" in refused(*words, "--seeds", "0")[0]
    cause, cure = refused("--run", str(together), "--resume", "--seeds", "3")
    assert "holds 2 seeds, not 3" in cause and "give 2" in cure
    for more in ((), ("--seeds", "2"), ("--seed", "7", "--seeds", "2")):
        cause, _ = refused(*smoke_words(together, *FLAGS, *more))
        assert "already holds a run" in cause
    cause, cure = refused("eval", "--run", str(together))
    assert "holds 2 seeds" in cause and "seed1" in cure
    assert "--seed" in refused("--run", str(together), "--resume", "--seed", "7")[0]
    largest = str(2**31 - 1)
    assert "seed" in refused(*words, "--seed", largest, "--seeds", "2")[0]
    assert "checkpoint.keep" in refused(*words, "--checkpoint.keep", "1", "--seeds", "2")[0]
    assert not (tmp_path / "run").exists()
    shared = [cj.Logger()]
    with pytest.raises(cj.ConfigError, match="shared by 2 seeds"):
        cj.train(cj.load_config("smoke.yaml"), tmp_path / "x", seeds=2, loggers=shared)  # type: ignore[call-overload]
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
def test_kill_9_leaves_a_group_that_goes_on_bit_for_bit(together, tmp_path):
    run = tmp_path / "run"
    marker = "seed 1: iter    1"
    code, lines = run_and_signal(run, marker, *FLAGS, "--seeds", "2", signals=(signal.SIGKILL,))
    assert code == -signal.SIGKILL and len(rows_of(run / "seed1")) < 3, lines
    assert main(["--run", str(run), "--resume"]) == 0
    for seed in ("seed0", "seed1"):
        assert rows_of(run / seed) == rows_of(together / seed)


@pytest.mark.slow
def test_over_two_devices_each_has_its_own_seeds(together, tmp_path):
    run = tmp_path / "run"
    with start(run, *FLAGS, "--seeds", "2", JAX_NUM_CPU_DEVICES="2") as process:
        lines = process.communicate()[0]
    assert process.returncode == 0, lines
    assert "2 device(s)" in lines
    for seed in ("seed0", "seed1"):
        assert_close(rows_of(run / seed), rows_of(together / seed))
