"""What one session leaves to the next: programs, where nothing that shapes them differs."""

import pytest

from cmrl_jax import registry
from cmrl_jax.config.files import load_config
from cmrl_jax.evaluation.session import Session, forget_programs

FLAGS = {"env.physics": "native", "model.net": "mlp", "train.capacity": "4800"}


def session(**flags):
    return Session(load_config("smoke.yaml", FLAGS | flags))


@pytest.fixture(autouse=True)
def fresh():
    forget_programs()
    yield
    forget_programs()


SAME = {
    "seed": "5",
    "name": "other",
    "train.env_steps": "2400",
    "train.minutes": "3",
    "eval.k": "0,1,2",
    "eval.final_goals": "7",
    "checkpoint.keep": "1",
    "log.progress": "false",
    "runtime.compile_cache": "",
}
OTHER = {
    "sac.lr": "1.0e-3",
    "env.horizon": "100",
    "env.obs_mode": "metaworld",
    "collect.lanes": "24",
    "goals.table": "zero",
    "tasks.train": "drawer-open,drawer-close",
    "runtime.matmul_precision": "default",
    "train.capacity": "2400",
}


@pytest.mark.parametrize("key", SAME)
def test_what_shapes_no_program_keeps_them(key):
    before, after = session(), session(**{key: SAME[key]})
    assert after.algorithm is before.algorithm and after.env is before.env
    assert after.evaluator(8) is before.evaluator(8)
    assert after.evaluator(8) is not before.evaluator(4)
    assert after.evaluator(8, policies=2) is not before.evaluator(8)


@pytest.mark.parametrize("key", OTHER)
def test_what_shapes_a_program_makes_another(key):
    assert session(**{key: OTHER[key]}).algorithm is not session().algorithm


def test_another_entry_of_the_registry_makes_another(monkeypatch):
    before, entries = session(), registry.ALGORITHMS
    again = registry.AlgorithmEntry(entries["cmrl"].make, entries["cmrl"].rules)
    monkeypatch.setitem(entries, "cmrl", again)
    assert session().algorithm is not before.algorithm


def test_an_evaluator_can_be_let_go():
    one = session()
    refused = one.evaluator(8)
    one.forget(refused)
    assert session().evaluator(8) is not refused
    many = [one.evaluator(lanes) for lanes in range(1, 7)]
    assert one.evaluator(6) is many[-1] and one.evaluator(1) is not many[0]


def test_a_few_are_kept_and_they_can_be_let_go():
    first = session()
    for lanes in ("12", "24", "36", "48"):
        session(**{"collect.lanes": lanes, "collect.context_episodes": "3"})
    assert session().algorithm is not first.algorithm
    again = session()
    forget_programs()
    assert session().algorithm is not again.algorithm
