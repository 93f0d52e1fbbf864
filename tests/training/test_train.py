"""The loop end to end at smoke size, through the command line, on real physics.

One run of `smoke.yaml` (module fixture) trains on mjx, without modules: those compile as long as
the physics and run in `undisturbed_modular`. What does not ask for mjx runs on MuJoCo C, which has
nothing to compile; the presets run two iterations.
"""

import dataclasses
import json
import re
import shutil
import subprocess
import sys

import jax
import numpy as np
import pytest
from run_helpers import ROOT, assert_same_result, native, rows_of, run_and_signal, smoke

from cmrl_jax.algorithms.cmrl.rules import lane_groups
from cmrl_jax.cli.main import main
from cmrl_jax.config.files import load_config
from cmrl_jax.evaluation.session import Session, forget_programs, load_policy
from cmrl_jax.jax_runtime import jit_once
from cmrl_jax.storage.checkpoint import full_store
from cmrl_jax.text import goal_files


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished smoke run, and the number of programs that were compiled ahead of time."""
    run = tmp_path_factory.mktemp("train") / "run"
    compiles = []
    forget_programs()
    with pytest.MonkeyPatch.context() as patch:
        original = jax.stages.Lowered.compile

        def counted(self, *args, **kwargs):
            compiles.append(self)
            return original(self, *args, **kwargs)

        patch.setattr(jax.stages.Lowered, "compile", counted)
        assert smoke(run, "--model.net", "mlp") == 0
    return run, len(compiles)


def test_a_run_leaves_what_the_design_lists(finished):
    run, compiles = finished
    names = {"config.yaml", "versions.json", "metrics.csv", "eval.json", "ckpt", "policy"}
    assert names <= {p.name for p in run.iterdir()}
    rows = rows_of(run)
    assert [row["iteration"] for row in rows] == ["0", "1", "2"]
    assert [row["env_steps"] for row in rows] == ["600", "1200", "1800"]
    assert [row["gradient_steps"] for row in rows] == ["0", "50", "100"]
    evaluated = [row["eval/window-close/k1/success_any"] for row in rows]
    assert evaluated[:1] == [""] and evaluated[1] != ""
    assert rows[0]["train/critic_loss"] == "" and float(rows[1]["train/critic_loss"]) > 0
    with full_store(run, read_only=True) as store:
        assert store.steps() == [2, 3]
    assert compiles == 2  # one training iteration, one evaluation episode: no third physics program


def test_every_figure_is_finite(finished):
    for row in rows_of(finished[0]):
        for name, text in row.items():
            assert text == "" or np.isfinite(float(text)), name
        assert row["train/physics_faults"] == "0.0"
        assert row["train/skipped"] in ("", "0.0")


def test_episodes_come_from_the_groups_that_the_config_asks_for(finished):
    rows = rows_of(finished[0])
    prior, text, posterior = lane_groups(load_config("smoke.yaml"))
    counts = [[row[f"train/episodes_{s}"] for s in ("prior", "text", "posterior")] for row in rows]
    # Iteration 0 has no context yet: its posterior lanes fall back on the text.
    assert counts[0] == [f"{3 * prior}.0", f"{3 * (text + posterior)}.0", "0.0"]
    assert counts[1] == counts[2] == [f"{3 * prior}.0", f"{3 * text}.0", f"{3 * posterior}.0"]


def test_the_same_seed_gives_the_same_csv_and_another_seed_does_not(undisturbed, tmp_path):
    assert smoke(tmp_path / "same", *native()) == 0
    assert rows_of(tmp_path / "same") == rows_of(undisturbed)
    assert smoke(tmp_path / "other", *native(1), "--seed", "1") == 0
    first, other = rows_of(undisturbed)[0], rows_of(tmp_path / "other")[0]
    assert first["train/drawer-open/return"] != other["train/drawer-open/return"]


@pytest.mark.slow
def test_resume_equals_an_undisturbed_run_bit_for_bit(tmp_path):
    """With modules and on mjx; `test_resume` has the same without either."""
    undisturbed, run = tmp_path / "undisturbed", tmp_path / "run"
    assert smoke(undisturbed) == 0
    assert smoke(run, "--train.env_steps", "600") == 0
    assert len(rows_of(run)) == 1
    assert smoke(run, "--resume") == 0
    assert_same_result(run, undisturbed)


def test_a_run_killed_before_its_first_save_resumes_from_the_start(undisturbed, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(undisturbed / "config.yaml", run)
    assert main(["--run", str(run), "--resume", "--train.env_steps", "600"]) == 0
    assert rows_of(run)[0] == rows_of(undisturbed)[0]


def test_resume_refuses_a_changed_field_by_name(undisturbed, refused):
    cause, cure = refused("--run", str(undisturbed), "--resume", "--sac.gamma", "0.9")
    assert "sac.gamma" in cause and cure


def test_resume_refuses_another_goal_table(undisturbed, tmp_path, monkeypatch, capsys):
    """The table of that name was made anew: same sentences, another release of the encoder."""
    with np.load(goal_files.table_path("minilm-l6-v2")) as data:
        np.savez(tmp_path / "goals-minilm-l6-v2.npz", **{**data, "revision": np.array("other")})
    monkeypatch.setattr(goal_files, "DATA", tmp_path)
    before = rows_of(undisturbed)
    assert main(["--run", str(undisturbed), "--resume", "--train.env_steps", "9000"]) == 2
    assert "was trained with another goal table" in capsys.readouterr().err
    assert rows_of(undisturbed) == before


def test_sigterm_saves_and_leaves_with_code_0_and_the_resume_command(undisturbed, tmp_path):
    run = tmp_path / "run"
    code, lines = run_and_signal(run, "iter    1", *native(100))
    assert code == 0, lines
    assert f"train.py --run {run} --resume" in lines[-1], lines
    rows = rows_of(run)
    for row, other in zip(
        rows[:2], rows_of(undisturbed), strict=False
    ):  # a longer run evaluates later
        assert {c: row[c] for c in row if "eval/" not in c} == {
            c: other[c] for c in other if "eval/" not in c
        }
    with full_store(run, read_only=True) as store:
        assert store.read_meta()["iteration"] == len(rows) >= 2


@pytest.mark.slow
def test_sigterm_during_the_compile_stops_before_the_first_iteration(tmp_path):
    """A signal before the loop leaves the untrained state and a command that goes on with it."""
    run = tmp_path / "run"
    marker = "compiling the training iteration"
    code, lines = run_and_signal(run, marker, *native(), JAX_ENABLE_COMPILATION_CACHE="false")
    assert code == 0, lines
    assert re.search(r"stopped after iteration 0; .*--resume", lines[-1]), lines
    assert rows_of(run) == []
    with full_store(run, read_only=True) as store:
        assert store.steps() == [0]


def test_eval_restores_the_policy_in_another_process(undisturbed, tmp_path):
    """The same goals, k and seed as the run's own final evaluation: the same figures."""
    out = tmp_path / "eval.json"
    words = ["eval", "--run", str(undisturbed), "--k", "0,1", "--goals", "2", "--json", str(out)]
    done = subprocess.run(
        [sys.executable, str(ROOT / "train.py"), *words], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    result, own = (json.loads(path.read_text()) for path in (out, undisturbed / "eval.json"))
    assert result["tasks"] == own["tasks"]
    assert list(result["tasks"]) == ["drawer-open", "drawer-close", "window-open", "window-close"]
    assert {"success_any", "success_last", "return"} <= result["tasks"]["window-close"]["1"].keys()
    assert (result["goals"], result["horizon"]) == (2, 50)
    assert "window-close" in done.stdout and "any step" in done.stdout


def test_evaluation_does_not_depend_on_what_was_evaluated_before_or_beside(undisturbed):
    """Trap 8: a belief that survived from one task to the next would change these figures."""
    config = load_config(str(undisturbed / "config.yaml"))
    session = Session(config)
    policies = [load_policy(undisturbed, session).params]
    evaluator = session.evaluator()
    trial = session.trial("heldout", config.eval.goals)
    first = evaluator.run(policies, trial, (0, 1), seed=0)
    again = evaluator.run(policies, trial, (1,), seed=0)
    np.testing.assert_array_equal(first[1].returns, again[1].returns)
    other = evaluator.run(policies, trial, (1,), seed=1)
    assert not np.array_equal(first[1].returns, other[1].returns)  # z is drawn
    # One goal a task in a padded batch scores as it does among others.
    alone = evaluator.run(policies, trial.of_goal(0), (1,), seed=0)
    np.testing.assert_allclose(alone[1].returns[:, :, 0], first[1].returns[:, :, 0], rtol=1e-4)


PRESETS = ("pearl", "mtsac", "sac", "ml4", "ml4-plain", "cmrl-paper", "ml4-large")


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_each_preset_runs_two_iterations_at_smoke_size(preset):
    config = load_config(f"{preset}.yaml")
    small = load_config("smoke.yaml")
    tasks, layers = len(config.tasks.train), config.model.modules[:2]
    config = dataclasses.replace(
        config,
        # The physics is not what differs; MuJoCo C has nothing to compile.
        env=dataclasses.replace(config.env, horizon=20, physics="native"),
        model=dataclasses.replace(
            config.model, modules=(*layers, 8), trunk_width=16, gating_width=8, mlp_hidden=(16, 16)
        ),
        encoder=dataclasses.replace(config.encoder, hidden=(16, 16), context_max=8),
        sac=dataclasses.replace(config.sac, batch=8, task_rows=2 * bool(config.sac.task_rows)),
        collect=dataclasses.replace(config.collect, lanes=4 * tasks, updates_per_vector_step=1),
        train=dataclasses.replace(small.train, capacity=400),
    )
    session = Session(config)
    iteration = session.algorithm.make_iteration(session.train_placements())
    traces = []

    def counted(state):
        traces.append(state)
        return iteration(state)

    program = jax.jit(counted)
    state = jit_once(session.algorithm.init)(jax.random.key(0))
    state, first = program(state)
    before = state.learner.actor_params
    state, second = program(state)
    assert np.isnan(first["critic_loss"]) and np.isfinite(second["critic_loss"])
    for name, value in second.items():
        assert np.all(np.isfinite(value)), name
    assert int(state.learner.gradient_steps) == 20 and float(second["skipped"]) == 0
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), before, state.learner.actor_params)
    assert all(jax.tree.leaves(moved))
    assert len(traces) == 1  # two calls, one trace: no weak type crept into the state
