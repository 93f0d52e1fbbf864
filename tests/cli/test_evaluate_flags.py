"""Flags of `eval` and `sweep`: what they hand on, and their mistakes."""

from dataclasses import asdict, fields
from pathlib import Path
from types import SimpleNamespace

import pytest

from cmrl_jax.cli.main import main
from cmrl_jax.config.files import load_config, to_yaml
from cmrl_jax.evaluation.options import EvalOptions
from envs.outputs import write_json


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def calls(here, replace_module):
    """Puts recorders in place of the two programs; returns the list of their keywords."""
    made = []
    record = lambda **kwargs: made.append(kwargs) or 0
    for module, function in (("cli.evaluate", "evaluate_run"), ("evaluation.sweep", "sweep")):
        replace_module(f"cmrl_jax.{module}", SimpleNamespace(**{function: record}))
    return made


def make_run(path: Path, config: str = "ml4.yaml") -> None:
    path.mkdir(parents=True)
    (path / "config.yaml").write_text(to_yaml(load_config(config)))


@pytest.mark.parametrize(
    ("words", "cause", "cure"),
    [
        (["eval"], "required: --run", "--help"),
        (["eval", "--run", "nope"], "run directory nope does not exist", "train"),
        (["eval", "--run", "x", "--k", "0,a"], "--k: a is no whole number", "in this range"),
        (["eval", "--run", "x", "--k", "0,-1"], "--k: -1 is no whole number", "in this range"),
        (["eval", "--run", "x", "--goals", "51"], "51 is no whole number from 1 to 50", "has 50"),
        (["eval", "--run", "x", "--horizon", "0"], "0 is no whole number from 1", "control steps"),
        (["eval", "--run", "x", "--goal-set", "hldout"], "'hldout'", "did you mean 'heldout'?"),
        (["eval", "--run", "x", "--lanes", "0"], "--lanes: 0 is no whole number from 1", "range"),
        (["eval", "--run", "x", "--eval-seeds", "0"], "--eval-seeds: 0 is no whole", "range"),
        (["eval", "--run", "x", "--tasks", "window-opn"], "unknown task", "'window-open'?"),
        (["eval", "--run", "x", "--tasks", "a,"], "unknown task 'a'", "valid: drawer-open"),
        (["eval", "--run", "x", "--k", "1,1"], "--k is '1,1'", "each once"),
        (["eval", "--run", "x", "--z", "no"], "--z: invalid choice", "--help"),
        (
            ["eval", "--run", "x", "--text", "shut it", "--paraphrases", "heldout"],
            "--text with --paraphrases",
            "one of the two",
        ),
        (
            ["eval", "--run", "x", "--z", "other", "--physics", "metaworld"],
            "--z other with --physics metaworld",
            "--z posterior",
        ),
        (["eval", "--run", "x", "--text", ""], "--text is empty", "--text-control zero"),
        (["sweep", "--runs", "x", "--text", " \t"], "--text is empty", "write a sentence"),
        (
            ["eval", "--run", "x", "--protocol", "task", "--goal-set", "train"],
            "--protocol task with --goal-set train",
            "name another",
        ),
        (
            ["eval", "--run", "x", "--protocol", "task", "--z", "shuffled"],
            "--protocol task with --z shuffled",
            "--protocol goal",
        ),
        (
            ["eval", "--run", "x", "--protocol", "task", "--paraphrases", "heldout"],
            "--protocol task with --paraphrases heldout",
            "--protocol goal",
        ),
        (
            ["eval", "--run", "x", "--protocol", "task", "--physics", "metaworld"],
            "--protocol task with --physics metaworld",
            "--physics native",
        ),
        (
            ["sweep", "--runs", "x", "--adapt", "search", "--compare", "2"],
            "--compare with --adapt",
            "leave --compare out",
        ),
        (["sweep"], "required: --runs", "--help"),
        (["sweep", "--runs", "x*"], "--runs x* matches no run", "runs/ml4-*"),
        (["sweep", "--runs", "x", "--checkpoints", "first"], "--checkpoints is 'first'", "all"),
        (["sweep", "--runs", "x", "--checkpoints", "20,020"], "is '20,020'", "each once"),
        (["sweep", "--runs", "x", "--physics", "metaworld"], "--physics: invalid", "--help"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_mistake_is_one_cause_and_one_cure(refused, here, words, cause, cure):
    got = refused(*words)
    assert cause in got[0] and cure in got[1]
    assert not list(here.iterdir())  # nothing was begun


PROTOCOL = [
    "--k", "0,1,5", "--tasks", "window-close,drawer-open", "--goals", "4", "--goal-set", "fresh:7",
    "--eval-seeds", "3", "--seed", "2", "--horizon", "500", "--physics", "native",
    "--policy", "sampled", "--z", "shuffled", "--paraphrases", "heldout",
    "--text-control", "shuffled", "--any-table", "--lanes", "64",
]  # fmt: skip
OPTIONS = EvalOptions(
    k=(0, 1, 5), tasks=("window-close", "drawer-open"), goals=4, goal_set="fresh:7", draws=3,
    seed=2, horizon=500, physics="native", policy="sampled", z="shuffled", paraphrases="heldout",
    text_control="shuffled", any_table=True, lanes=64,
)  # fmt: skip


def test_eval_hands_over_its_flags(calls, here):
    make_run(here / "r")
    files = ["--checkpoint", "12", "--json", "out/f.json", "--csv", "out/f.csv"]
    assert main(["eval", "--run", "r", *PROTOCOL, *files]) == 0
    assert main(["eval", "--run", "r"]) == 0
    (here / "w").mkdir()
    text = ["--text", "shut it", "--weights", "w"]
    assert main(["eval", "--run", "r", *text]) == 0
    assert calls[0] == {
        "run": Path("r"), "options": OPTIONS, "checkpoint": 12,
        "json_path": Path("out/f.json"), "csv_path": Path("out/f.csv"), "force": False,
    }  # fmt: skip
    assert calls[1] == {
        "run": Path("r"), "options": EvalOptions(), "checkpoint": None,
        "json_path": None, "csv_path": None, "force": False,
    }  # fmt: skip
    assert calls[2]["options"] == EvalOptions(text="shut it", weights=Path("w"))
    assert not (here / "out").exists()  # tried, and left to the command to make


def test_every_flag_changes_its_option(calls, here):
    """None is parsed and then left behind."""
    make_run(here / "r", "ml4.yaml")
    given = {
        "k": "3", "tasks": "window-open", "goals": "3", "goal_set": "fresh:3", "seed": "3",
        "horizon": "3", "physics": "native", "policy": "sampled", "z": "prior", "lanes": "3",
        "adapt": "search", "protocol": "task", "text_control": "zero", "paraphrases": "heldout",
        "text": "shut it", "weights": ".", "draws": "3",
    }  # fmt: skip
    named = {field.name for field in fields(EvalOptions)}
    episodes = {"adaptation_episodes", "evaluation_episodes"}
    assert named - episodes == {*given, "any_table"}
    for name, word in given.items():
        flag = "eval-seeds" if name == "draws" else name.replace("_", "-")
        assert main(["eval", "--run", "r", f"--{flag}", word]) == 0
        old, new = asdict(EvalOptions()), asdict(calls[-1]["options"])
        assert {n for n in named if old[n] != new[n]} == {name}
    for flag in episodes:
        words = [f"--{flag.replace('_', '-')}", "7", "--physics", "metaworld"]
        assert main(["eval", "--run", "r", *words]) == 0
        assert getattr(calls[-1]["options"], flag) == 7


def test_a_search_needs_arms(calls, refused, here):
    make_run(here / "p", "mtsac.yaml")
    cause, cure = refused("eval", "--run", "p", "--adapt", "search", "--k", "0")
    assert cause == "--adapt search with model.conditioning task_id (p)"
    assert cure == "leave it out, or use one of: posterior"


def test_sweep_hands_over_its_flags(calls, refused, here, replace_module):
    for name in ("a-2", "a-1", "b"):
        make_run(here / "runs" / name)
    (here / "runs" / "a-3").mkdir()  # holds no run
    patterns = ["--runs", "runs/b", "runs/a-*", "runs/*"]
    files = ["--json", "f.json", "--csv", "f.csv"]
    assert main(["sweep", *patterns, "--checkpoints", "20,40", *PROTOCOL, *files]) == 0
    assert main(["sweep", "--runs", "runs/b", "--compare", "8"]) == 0
    assert calls[0] == {
        "runs": [Path("runs/b"), Path("runs/a-1"), Path("runs/a-2")], "checkpoints": (20, 40),
        "options": OPTIONS, "json_path": Path("f.json"), "csv_path": Path("f.csv"),
        "compare": None, "force": False,
    }  # fmt: skip
    replace_module("cmrl_jax.bench.sweep", SimpleNamespace(compared=lambda *args: args))
    members, table, progress = (object() for _ in range(3))
    compared = calls[1].pop("compare")(members, table, progress)
    assert compared == (members, EvalOptions(), table, 8, progress)
    assert calls[1] == {
        "runs": [Path("runs/b")], "checkpoints": "last", "options": EvalOptions(),
        "json_path": None, "csv_path": None, "force": False,
    }  # fmt: skip
    make_run(here / "runs" / "m", "mtsac.yaml")
    assert "(runs/m)" in refused("sweep", "--runs", "runs/*", "--k", "0,1")[0]


@pytest.mark.parametrize("command", [["eval", "--run", "r"], ["sweep", "--runs", "r"]])
def test_outputs_of_others_stay(calls, refused, here, command):
    make_run(here / "r")
    other = {"eval": "sweep", "sweep": "eval"}[command[0]]
    own, foreign = here / "own.json", here / "foreign.json"
    write_json(own, command[0], {})
    write_json(foreign, other, {})
    (here / "metrics.csv").write_text("iteration,env_steps\n0,1\n")
    for words in (["--json", "foreign.json"], ["--csv", "metrics.csv"], ["--csv", "own.json"]):
        cause, cure = refused(*command, *words)
        assert f"{words[1]} is there" in cause and "--force" in cure
        assert main([*command, *words, "--force"]) == 0
    assert calls[-1]["force"] is True
    assert main([*command, "--json", "own.json"]) == 0
    cause, cure = refused(*command, "--json", "f", "--csv", "./f")
    assert "--json and --csv are one file" in cause and "of its own" in cure


def test_eval_without_a_latent_does_not_adapt(calls, refused, here):
    make_run(here / "r", "mtsac.yaml")
    assert "--k 0,2" in refused("eval", "--run", "r", "--k", "0,2")[0]
    own = ["--physics", "metaworld", "--adaptation-episodes", "5"]
    assert "--adaptation-episodes 5" in refused("eval", "--run", "r", *own)[0]
    assert main(["eval", "--run", "r"]) == 0  # the run's own final_k is 0
