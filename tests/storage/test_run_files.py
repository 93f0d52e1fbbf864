"""Files of a run as they come back after years: out of order, cut, edited, or somebody else's."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest
from run_file_helpers import CSV, evaluation, write_run

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.storage.documents import read_json
from cmrl_jax.storage.run_files import (
    find_evaluation,
    read_adaptation,
    read_evaluation,
    read_metrics,
)

ROOT = Path(__file__).parents[2]


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path / "run", by_k={0: 0.1, 1: 0.2, 2: 0.6})


def test_every_axis_is_sorted_where_it_is_read(run, tmp_path):
    (run / "eval.json").write_text(json.dumps(evaluation({10: 0.9, 2: 0.2, 0: 0.1})))
    curve = read_evaluation(run / "eval.json").tasks["window-open"]
    assert [(k, f["success_any"]) for k, f in curve.items()] == [(0, 0.1), (2, 0.2), (10, 0.9)]

    header, *rows = CSV.splitlines()
    (run / "metrics.csv").write_text("\n".join([header, rows[2], rows[0], rows[1]]) + "\n")
    assert [row["env_steps"] for row in read_metrics(run)] == [100, 200, 300]

    path = tmp_path / "F.json"
    curves = {"z": evaluation({20: 0.9, 5: 0.5, 0: 0.0})["tasks"]["window-open"]}
    path.write_text(json.dumps({"task": "window-open", "curves": curves}))
    found = read_adaptation(path)
    assert (found.task, list(found.curves["z"])) == ("window-open", [0, 5, 20])


def test_a_row_lacks_what_was_not_taken(run):
    (run / "metrics.csv").write_text(CSV.replace("1.0,", "nan,inf"))
    taken = [sorted(name.rpartition("/")[2] for name in row) for row in read_metrics(run)]
    always = ["env_steps", "iteration"]
    both = [*always, "success_any", "success_any"]
    assert taken == [[*always, "success_any"], both, always]


def test_what_a_spreadsheet_saves_is_read_as_before(run):
    before = read_metrics(run)
    windows = "\ufeff" + CSV.replace("\n", "\r\n")
    (run / "metrics.csv").write_bytes(windows.encode())
    assert read_metrics(run) == before


def test_half_a_row_at_the_end_is_left_out_and_said(run, capsys):
    whole = read_metrics(run)
    for cut in (1, 3, 8):  # without the last character, a cell, most of the row
        (run / "metrics.csv").write_text(CSV[:-cut])
        assert read_metrics(run) == whole[:-1]
        assert (
            capsys.readouterr().err == f"{run}/metrics.csv ends in half a row, which is left out\n"
        )


GOOD = evaluation({0: 0.1, 1: 0.2})
JSON = json.dumps(GOOD)
DAMAGED_EVALUATIONS = {
    "empty": (b"", "is not JSON"),
    "cut": (JSON[:100].encode(), "is not JSON"),
    "two documents": ((JSON + JSON).encode(), "is not JSON"),
    "stray byte": (
        JSON.encode() + b"\xff",
        f"is not UTF-8 text: invalid start byte at byte {len(JSON)}",
    ),
    "UTF-16": (JSON.encode("utf-16"), "is not UTF-8 text"),
    "brackets": (b"[" * 200_000, "brackets"),
    "list": (b"[1]", "holds no JSON object, but a list"),
    "number": (b"3", "holds no JSON object, but a number"),
    "null": (b"null", "holds no JSON object, but nothing"),
    "NaN": (JSON.replace("0.2,", "NaN,").encode(), "NaN is no number"),
    "infinity": (JSON.replace("0.2,", "-Infinity,").encode(), "-Infinity is no number"),
    "overflow": (JSON.replace("0.2,", "1e999,").encode(), "window-open, k = 1: success_any is no"),
    "many digits": (JSON.replace("0.2,", f"{'9' * 400},").encode(), "success_any is no number"),
    "text": (JSON.replace("0.2,", '"0.2",').encode(), "success_any is no number"),
    "true": (JSON.replace("0.2,", "true,").encode(), "success_any is no number"),
    "no tasks": (b'{"goals": 2}', "has no evaluation under 'tasks'"),
    "tasks as list": (b'{"tasks": [1]}', "has no evaluation under 'tasks'"),
    "task without k": (b'{"tasks": {"window-open": {}}}', "window-open has no figures"),
    "k without figures": (b'{"tasks": {"window-open": {"0": 1}}}', "k = 0 has no figures"),
    "a figure less": (JSON.replace("success_last", "last").encode(), "k = 0: success_last is no"),
    "k is no count": (JSON.replace('"1": {', '"1.5": {').encode(), "'1.5' is no k"),
    "k twice": (JSON.replace('"1": {', '"0": {').encode(), "the key '0' stands twice"),
    "k twice in other digits": (JSON.replace('"1": {', '"00": {').encode(), "'00' is no k, or one"),
}


@pytest.mark.parametrize("damage", DAMAGED_EVALUATIONS)
def test_a_damaged_evaluation_is_two_lines(run, damage, refused):
    content, said = DAMAGED_EVALUATIONS[damage]
    (run / "eval.json").write_bytes(content)
    cause, cure = refused("plot", "--run", str(run))
    assert "eval.json" in cause and said in cause and "move it away" in cure
    assert not list((run / "plots").glob("*"))


DAMAGED_METRICS = {
    "empty": ("", "has no row yet"),
    "header alone": (CSV.splitlines()[0] + "\n", "has no row yet"),
    "a cell less": (CSV.replace("0.5,0.25", "0.5"), "metrics.csv:3 has 3 cells for 4 columns"),
    "a cell more": (CSV + "3,400,1.0,,1\n", "metrics.csv:5 has 5 cells for 4 columns"),
    "open quote": (CSV.replace("0.5", '"0.5'), "has 3 cells for 4 columns"),
    "text": (CSV.replace("0.5,", "0.5x,"), "metrics.csv:3 has the text '0.5x' in column train/"),
    "stray byte": (CSV.encode() + b"\xff\n", "is not UTF-8 text"),
    "no env steps": (CSV.replace("env_steps", "steps"), "has no number in column 'env_steps'"),
    "env steps not filled": (CSV.replace("1,200", "1,"), "metrics.csv:3 has no number in column"),
    "endless steps": (CSV.replace("1,200", "1,inf"), "metrics.csv:3 has no number in column"),
    "rows twice": (CSV + "7,200,0.5,\n", "metrics.csv:5 has 200 env steps a second time"),
    "column twice": (CSV.replace("iteration", "env_steps"), "has the column 'env_steps' twice"),
    "a field without end": (CSV + f'3,400,"{"1" * 200_000}",\n', "metrics.csv:5 is no CSV"),
}


@pytest.mark.parametrize("damage", DAMAGED_METRICS)
def test_damaged_metrics_are_two_lines(run, damage, refused):
    content, said = DAMAGED_METRICS[damage]
    content = content if isinstance(content, bytes) else content.encode()
    (run / "metrics.csv").write_bytes(content)
    cause, cure = refused("plot", "--run", str(run))
    assert "metrics.csv" in cause and said in cause and cure
    assert not list((run / "plots").glob("*"))


def test_what_is_no_file_is_two_lines(run, refused):
    (run / "metrics.csv").unlink()
    (run / "metrics.csv").mkdir()
    assert "metrics.csv does not exist" in refused("plot", "--run", str(run))[0]
    with pytest.raises(ConfigError) as error:
        read_json(run, "cure")
    assert str(error.value) == f"cannot read {run}: Is a directory\ncure"
    with pytest.raises(ConfigError) as error:
        find_evaluation(run / ("x" * 300))
    assert "File name too long" in error.value.cause


def test_no_cut_and_no_lost_byte_is_taken_for_another_evaluation(tmp_path):
    """Wherever a file ends, it is refused; whichever byte it lacks, it is read or refused."""
    path, outcomes = tmp_path / "eval.json", []
    for n in range(len(JSON)):
        path.write_text(JSON[:n])
        with pytest.raises(ConfigError):
            read_evaluation(path)
        path.write_text(JSON[:n] + JSON[n + 1 :])
        try:
            outcomes.append(bool(read_evaluation(path).tasks))
        except ConfigError as error:
            outcomes.append(not (error.cause and error.cure))
    assert 0.1 < np.mean(outcomes) < 0.9


def test_damaged_curves_of_fine_tuning_are_refused(tmp_path):
    path, curve = tmp_path / "F.json", GOOD["tasks"]["window-open"]
    for document, said in (
        ({"curves": {"z": curve}}, "names no task"),
        ({"task": "window-open"}, "has no curves"),
        ({"task": "window-open", "curves": {"z": {"x": curve["0"]}}}, "z: 'x' is no episodes"),
        ({"task": "window-open", "curves": {"z": [1]}}, "z has no figures"),
    ):
        path.write_text(json.dumps(document))
        with pytest.raises(ConfigError) as error:
            read_adaptation(path)
        assert said in error.value.cause and "finetune --json" in error.value.cure


def test_results_keep_no_damaged_run(tmp_path, monkeypatch):
    """scripts/experiments.py replaces nothing before it has read what it copies."""
    monkeypatch.syspath_prepend(ROOT)
    experiments = importlib.import_module("scripts.experiments")
    kept, words = tmp_path / "kept", ["train.py", "--config", "pearl.yaml"]
    header, *rows = CSV.splitlines()
    many = [header, rows[1], *[f"{n},{n}00,0.5," for n in range(3, 300)]]
    run = write_run(tmp_path / "run", "\n".join(many) + "\n", {0: 0.2})
    (run / "versions.json").write_text("{}")
    experiments.keep(run, kept, words)
    assert (kept / "command.txt").read_text() == "python train.py --config pearl.yaml\n"
    thinned = (kept / "metrics.csv").read_text()
    # Every third row, the evaluated one and the last, as they were written.
    assert thinned.splitlines() == [many[0], *many[1:-1:3], many[-1]]
    for file, damage in (("metrics.csv", "1,2\n"), ("eval.json", "{")):
        sound = (run / file).read_text()
        (run / file).write_text(sound + damage)
        with pytest.raises(ConfigError) as error:
            experiments.keep(run, kept, words)
        assert file in error.value.cause
        (run / file).write_text(sound)
        assert read_evaluation(kept / "eval.json") and (kept / "metrics.csv").read_text() == thinned
