"""The adaptation table: from the evaluations' JSON to rows and lines (scripts/adaptation.py)."""

import importlib
import json

import pytest
from run_file_helpers import write_run

from cmrl_jax.config.schema import ConfigError

NAME = "cmrl-window-open-s3"


def figures(success_any, success_last=0.0, **more):
    return {"success_any": success_any, "success_last": success_last} | more


@pytest.fixture
def table(monkeypatch, tmp_path):
    """The script with results of its own, and `put(evaluation, document)`."""
    script = importlib.import_module("scripts.adaptation")
    monkeypatch.setattr(script, "SCORES", tmp_path / "scores")
    monkeypatch.setattr(script, "RESULTS", tmp_path)

    def put(evaluation, document, name=NAME):
        path = tmp_path / "scores" / name / f"{evaluation}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(document))

    monkeypatch.setattr(script, "put", put, raising=False)
    return script


def by_k(**ks):
    return {"tasks": {"window-open": {k.removeprefix("k"): found for k, found in ks.items()}}}


def test_rows_name_fold_method_protocol_seed_and_k(table):
    table.put("search-task", by_k(k0=figures(0.1), k20=figures(0.9, 0.8)))
    table.put("posterior-goal", by_k(k20=figures(0.2)))
    rows = table.rows_of(NAME)
    common = {"fold": "window-open", "seed": 3}
    assert rows == [
        common | {"method": "cmrl", "protocol": "task", "k": 0} | figures(0.1),
        common | {"method": "cmrl", "protocol": "task", "k": 20} | figures(0.9, 0.8),
        common | {"method": "cmrl-posterior", "protocol": "goal", "k": 20} | figures(0.2),
    ]


def test_controls_of_arms_are_the_mean_the_trained_one_unturned_and_the_best(table):
    """Four z in eight views: arm 8 z + view, the task's own z first."""
    worth = {f"k{arm}": figures(0.0) for arm in range(32)}
    worth["k8"], worth["k24"], worth["k9"] = figures(0.3), figures(0.6), figures(1.0, 0.5)
    table.put("arms", by_k(**worth))
    found = {r["method"]: r for r in table.rows_of(NAME) if (r["protocol"], r["k"]) == ("task", 5)}
    assert found["random-arm"]["success_any"] == pytest.approx(1.9 / 32)
    assert found["blind-arm"]["success_any"] == pytest.approx(0.9 / 3)  # of arms 8, 16 and 24
    assert (found["oracle-arm"]["success_any"], found["oracle-arm"]["success_last"]) == (1.0, 0.5)


def test_a_goal_is_the_mean_over_its_draws(table, tmp_path):
    out, cells = tmp_path / "search-task.json", tmp_path / "search-task.csv"
    out.write_text(json.dumps(by_k(k5=figures(0.5))))
    lines = ["task,goal,draw,k,success_any,success_last"]
    lines += ["window-open,0,0,5,1.0,0.0", "window-open,0,1,5,1.0,1.0", "window-open,1,0,5,0.0,0.0"]
    cells.write_text("\n".join(lines) + "\n")
    table.keep_goals(cells, out)
    goals = json.loads(out.read_text())["tasks"]["window-open"]["5"]["goals"]
    assert goals == {"success_any": [1.0, 0.0], "success_last": [0.5, 0.0]}
    assert not cells.exists()


def test_episodes_needed_is_the_first_read_out_with_enough(table):
    curve = lambda *pairs: {str(k): figures(success) for k, success in pairs}
    curves = {"search": curve((0, 0.0), (5, 0.8), (20, 1.0)), "scratch": curve((5, 0.1), (50, 0.7))}
    table.put("finetune", {"curves": curves}, name="cmrl-window-open-s0")
    rows = table.rows_of("cmrl-window-open-s0")
    assert {r["method"] for r in rows} == {"finetune", "scratch"}
    assert table.episodes_needed(rows)[2:] == ["| window-open | 5 |  |"]


def test_every_run_is_told_what_is_held_out(table):
    for name in table.runs():
        words, (_, fold, seed) = table.typed(name), table.parts(name)
        train = words[words.index("--tasks.train") + 1].split(",")
        assert sorted([*train, fold]) == sorted(table.TASKS) and len(set(train)) == 3
        assert words[words.index("--seed") + 1] == str(seed)
    assert len(set(table.runs())) == len(table.KINDS) * len(table.TASKS) * len(table.SEEDS)


def test_a_damaged_run_is_kept_whole_or_not_at_all(table, tmp_path, monkeypatch):
    """What has a policy in results/ is not kept again: its learning curves come first."""
    for name in ("RUNS", "POLICIES"):
        monkeypatch.setattr(table, name, tmp_path / name)
    name = "rl2-window-close-s0"
    run = write_run(tmp_path / "RUNS" / name, by_k={0: 0.2})
    (run / "versions.json").write_text("{}")
    (run / "policy" / "7").mkdir(parents=True)
    (run / "policy" / "7" / "data").write_text("weights")
    sound = (run / "metrics.csv").read_text()
    (run / "metrics.csv").write_text(sound + "1,2\n")
    with pytest.raises(ConfigError):
        table.train([name])
    assert not (tmp_path / "POLICIES" / name).exists()
    (run / "metrics.csv").write_text(sound)
    assert table.train([name]) == 0
    assert (tmp_path / "POLICIES" / name / "policy" / "7.zip").is_file()
    assert (tmp_path / "curves" / name / "metrics.csv").read_text() == sound
    spoken = (tmp_path / "curves" / name / "command.txt").read_text()
    assert spoken.startswith("python train.py --config rl2.yaml") and "--resume" not in spoken
