"""What a sweep scores: what names a cell and a program, and how checkpoints share batches."""

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policy_fixtures import random_policy, save_run, small_config

from cmrl_jax import registry
from cmrl_jax.algorithms.cmrl.rules import Rules
from cmrl_jax.config.schema import Config, leaves
from cmrl_jax.evaluation.evaluator import Evaluator
from cmrl_jax.evaluation.options import EvalOptions
from cmrl_jax.evaluation.session import Session
from cmrl_jax.evaluation.targets import IDLE, Target, columns_of, program_key, targets_of
from cmrl_jax.evaluation.trials import Plan, eval_lanes, fitted, plan_batches
from cmrl_jax.text.goal_files import table_path


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with one policy checkpoint."""
    return save_run(tmp_path_factory.mktemp("runs") / "b", Session(small_config()), seeds=(3,))


def test_plans():
    assert plan_batches(4, tasks=4, per_task=50, budget=8192) == Plan(4, 200)
    assert plan_batches(4, tasks=4, per_task=50, budget=256) == Plan(4, 50)
    assert plan_batches(20, tasks=4, per_task=50, budget=256) == Plan(5, 50)
    assert plan_batches(1, tasks=4, per_task=50, budget=256) == Plan(1, 200)
    assert plan_batches(4, tasks=1, per_task=250, budget=100) == Plan(1, 100)
    for policies, lanes, needed in ((4, 50, 1100), (1, 50, 3000), (9, 7, 10**6)):
        plan = Plan(policies, lanes)
        assert fitted(plan, needed, None) == fitted(plan, 1000, 1000) == plan
        smaller = fitted(plan, needed, 1000)
        size = smaller.policies * smaller.lanes
        assert 1 <= size < policies * lanes
        assert size <= policies * lanes * 1000 / needed or smaller.policies == 1
    assert fitted(Plan(1, 2), 10**9, 1) == Plan(1, 1)


@pytest.mark.parametrize(("policies", "room", "side"), [(6, 5, 3), (11, 10, 6), (9, 4, 3)])
def test_batches_are_equally_full(policies, room, side):
    """Not 5 and then 1 beside 4 copies of itself, which cost as much as 5."""
    assert plan_batches(policies, tasks=4, per_task=50, budget=50 * room + 6).policies == side
    assert fitted(Plan(policies, 50), needed=policies * 50, limit=50 * room) == Plan(side, 50)


def test_batches_by_task_are_narrow_where_lanes_cost():
    """Ten draws of one task learn in ten lanes; in 256 they would play each of them 25 times."""
    by_task = EvalOptions(protocol="task", draws=10)
    assert [eval_lanes(by_task, tasks, unit=40) for tasks in (1, 4, 5)] == [40, 40, 80]
    assert eval_lanes(replace(by_task, draws=1000), tasks=4, unit=40) == 256
    assert eval_lanes(EvalOptions(draws=10), tasks=1, unit=40) == 256
    assert eval_lanes(EvalOptions(), tasks=1, unit=40) == 80
    assert eval_lanes(replace(by_task, lanes=7), tasks=4, unit=40) == 7


def test_another_policy_in_its_place_is_another_cell(run, tmp_path):
    copy = shutil.copytree(run, tmp_path / "b")
    named = lambda: columns_of(targets_of(copy, "all", EvalOptions())[0], EvalOptions())
    before, listed = named(), copy / "policy" / "1" / "sha256.txt"
    listed.write_text(listed.read_text().replace("a", "b"))  # as of other weights
    changed = {name for name, value in named().items() if value != before[name]}
    assert changed == {"policy_sha256"} and before["policy_sha256"]


def test_a_policy_without_its_list_of_files_is_known_by_the_files(run, tmp_path):
    copy = shutil.copytree(run, tmp_path / "b")
    named = lambda: columns_of(targets_of(copy, "all", EvalOptions())[0], EvalOptions())
    before, step = named(), copy / "policy" / "1"
    (step / "sha256.txt").unlink()
    assert named() == before
    victim = max((p for p in step.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    victim.write_bytes(victim.read_bytes()[:-1] + b"!")
    changed = {name for name, value in named().items() if value != before[name]}
    assert changed == {"policy_sha256"}


def test_cells_with_sentences_of_a_table_name_the_table(run, tmp_path):
    [target] = targets_of(run, "all", EvalOptions())
    with np.load(table_path("minilm-l6-v2")) as data:
        np.savez(tmp_path / "t.npz", **{**data, "revision": np.array("other")})
    goals = replace(target.config.goals, table=str(tmp_path / "t.npz"))
    other = replace(target, config=replace(target.config, goals=goals))
    for options, differs in (
        (EvalOptions(), False),  # the checkpoint's own sentences
        (EvalOptions(any_table=True), False),
        (EvalOptions(text_control="zero", paraphrases="heldout"), False),
        (EvalOptions(text_control="shuffled"), False),
        (EvalOptions(any_table=True, paraphrases="heldout"), True),
    ):
        names = [columns_of(t, options) for t in (target, other)]
        changed = {name for name in names[0] if names[0][name] != names[1][name]}
        assert changed == ({"sentences"} if differs else set()), options
    two = replace(target.config, tasks=replace(target.config.tasks, test=()))
    options = EvalOptions(tasks=("window-close",))  # which no checkpoint of that run holds
    assert columns_of(replace(target, config=two), options)["sentences"] is not None


CHANGED = {
    "tasks.train": ("window-open",), "tasks.test": (), "env.physics": "mjx",
    "env.variation": "fixed_50", "env.obs_mode": "canonical", "collect.initial": "prior",
    "collect.context_source": "all", "collect.context_lanes": "prior", "sac.variant": "v",
    "sac.alpha": "shared", "sac.reward_norm": "global", "sac.task_reduce": "sum",
    "sac.loss_balance": "sac_temp", "kl.reduce": "sum_tasks", "eval.k": (0,), "eval.final_k": (1,),
    "collect.group_frac": (0.5, 0.0, 0.5), "runtime.matmul_precision": "default",
}  # fmt: skip


def changed(config, name):
    """A configuration with one leaf changed."""
    sections, key = name.split(".")[:-1], name.split(".")[-1]
    owner = config
    for section in sections:
        owner = getattr(owner, section)
    old: Any = getattr(owner, key)
    if name in CHANGED:
        new = CHANGED[name]
    elif isinstance(old, bool):
        new = not old
    elif isinstance(old, str):
        new = f"{old}x"
    else:
        new = (*old, 1) if isinstance(old, tuple) else old + 1
    assert new != old, name
    owner = replace(owner, **{key: new})
    return replace(config, **{sections[0]: owner}) if sections else owner


def idle_keys(config, names):
    """Those of `names` that leave the program's key as it is."""
    key_of = lambda config: program_key(Target(Path("r"), 1, config, (0,), ("window-open",)))
    return {name for name in names if key_of(changed(config, name)) == key_of(config)}


NAMES = [name for name, _, _ in leaves(Config())]


@pytest.fixture
def twins(monkeypatch):
    """The names that `changed` makes of registered ones are registered, too."""
    for entries in (registry.ALGORITHMS, registry.ENVIRONMENTS):
        for name in list(entries):
            monkeypatch.setitem(entries, f"{name}x", entries[name])


def test_a_program_is_named_by_all_that_is_not_known_to_be_idle(twins):
    """Also by a key of the schema that nobody thought of when the list was written."""
    config = small_config()
    idle = idle_keys(config, NAMES)
    known = (*IDLE, *Rules.IDLE)
    assert idle == {n for n in NAMES if n in known or f"{n.partition('.')[0]}." in known}
    assert not idle & {"runtime.matmul_precision", "env.horizon", "encoder.poe", "collect.chunk"}
    assert all(any(n.startswith(entry) for n in NAMES) for entry in known)  # none is outdated
    told = replace(config, model=replace(config.model, conditioning="task_id"))
    assert not idle_keys(told, ["tasks.train"])


def test_a_search_of_fewer_tasks_has_its_own_program():
    """A search has arms for each training task, so its program is another with fewer of them."""
    config = small_config()
    other = replace(config, tasks=replace(config.tasks, train=config.tasks.train[:2], test=()))
    keys = lambda adapt: [
        program_key(Target(Path("r"), 1, c, (0,), ("window-open",)), adapt) for c in (config, other)
    ]
    assert len(set(keys("search"))) == 2 and len(set(keys("posterior"))) == 1


def test_what_is_idle_changes_no_program(twins):
    """Every idle key changed at once: the traced episode is the same, to the last operation."""
    config = small_config()
    other = config
    for name in idle_keys(config, NAMES):
        other = changed(other, name)
    assert other.sac.lr != config.sac.lr

    def program(config):
        session = Session(replace(config, tasks=small_config().tasks))
        evaluator = Evaluator(config, session.env, session.agent, lanes=2)
        traced = evaluator.traced(random_policy(session, 1), text_width=384)
        return re.sub(r"0x[0-9a-f]+", "", str(traced.jaxpr))

    assert program(other) == program(config)
    assert program(changed(config, "sac.normalize_obs")) != program(config)


def test_cells_with_anothers_z_are_of_one_set_of_lanes(run):
    [target] = targets_of(run, "all", EvalOptions())
    base = EvalOptions(goals=50)
    options = [(base, False), (replace(base, z="shuffled"), True), (replace(base, z="other"), True)]
    for many, differs in options:
        few = replace(many, goals=10, tasks=("window-open",))
        a, b = columns_of(target, few), columns_of(target, many)
        assert (a != b) == differs
