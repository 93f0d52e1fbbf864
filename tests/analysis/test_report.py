"""The page of `report`: what it says of small runs written here, and that it needs nothing else."""

import base64
import json
import re
from typing import Any

import numpy as np
import pytest
from run_file_helpers import evaluation, write_run

from cmrl_jax.analysis.report import write_report
from cmrl_jax.cli.main import main
from cmrl_jax.config.files import load_config
from cmrl_jax.config.presets import preset_of
from cmrl_jax.config.schema import ConfigError
from cmrl_jax.evaluation.statistics import seeds_band, wilson_interval


def page_of(runs, tmp_path, files=()):
    """The page's text without plotly's own code."""
    text = write_report(runs, files, tmp_path / "page.html").read_text()
    head, _, rest = text.partition("<script>")
    return head + rest.partition("</script></head>")[2]


def figures_in(page):
    """Of each panel its title and traces."""
    cells = re.findall(
        r"<figure><h3>(.*?)</h3><div class=plot><script[^>]*>(.*?)</script>", page, re.DOTALL
    )
    return [(title, plain(json.loads(data)["data"])) for title, data in cells]


def plain(value: Any) -> Any:
    """plotly's JSON with its packed arrays as lists."""
    if isinstance(value, list):
        return [plain(item) for item in value]
    if not isinstance(value, dict):
        return value
    if "bdata" in value:
        return np.frombuffer(base64.b64decode(value["bdata"]), value["dtype"]).tolist()
    return {key: plain(item) for key, item in value.items()}


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path / "single", by_k={0: 0.5, 2: 1.0}, flags={"eval.k": "0"}, goals=50)


def test_curves_are_those_of_the_csv(run, tmp_path):
    panels = figures_in(page_of([run], tmp_path))
    title, traces = panels[0]
    training = next(t for t in traces if "any step" in t["name"])
    assert title == "window-open"
    assert (training["x"], training["y"]) == ([100, 200, 300], [0.0, 0.5, 1.0])
    (mark,) = [t for t in traces if "evaluation" in t["name"]]
    assert (mark["x"], mark["y"]) == ([200], [0.25])


def test_an_evaluation_has_the_interval_of_its_goals(run, tmp_path):
    page = page_of([run], tmp_path)
    (trace,) = [t for _, ts in figures_in(page) for t in ts if t.get("x") == [0, 2]]
    low, high = wilson_interval(0.5, 50)
    assert trace["error_y"]["array"][0] == pytest.approx(high - 0.5)
    assert trace["error_y"]["arrayminus"][0] == pytest.approx(0.5 - low)
    assert f"{low:.2f} to {high:.2f}" in page


def test_seeds_are_one_line_with_a_band(tmp_path):
    runs = [write_run(tmp_path / f"x-seed{n}", flags={"seed": n}) for n in (0, 1)]
    page = page_of(runs, tmp_path)
    _, traces = figures_in(page)[0]
    lines = [t for t in traces if t.get("name", "").endswith("training, any step")]
    assert len(lines) == 1 and any(t.get("fill") == "tonexty" for t in traces)


def test_what_was_run_is_the_preset_and_its_flags(tmp_path):
    run = write_run(tmp_path / "r", flags={"sac.batch": 16, "seed": 3})
    page = page_of([run], tmp_path)
    assert "smoke.yaml" in page and "sac.batch: 16" in page
    assert "python train.py --config smoke.yaml --seed 3 --sac.batch 16" in page


@pytest.mark.parametrize("name", ["ml4", "ml4-plain", "pearl", "sac", "rl2", "maml"])
def test_a_packaged_configuration_is_its_own_preset(name):
    assert preset_of(load_config(name)) == (f"{name}.yaml", {})


def test_files_of_eval_and_finetune_are_added(run, tmp_path):
    ours, tuned = tmp_path / "search.json", tmp_path / "tuned.json"
    ours.write_text(json.dumps(evaluation({0: 0.1, 20: 0.9}, adapt="search", protocol="task")))
    curve = {"0": {"success_any": 0.0, "success_last": 0.0, "return": 1.0}}
    tuned.write_text(json.dumps({"task": "window-close", "curves": {"scratch": curve}}))
    page = page_of([run], tmp_path, [ours, tuned])
    assert "(search, task)" in page and "Fine-tuning" in page
    assert any(t.get("x") == [0, 20] for _, traces in figures_in(page) for t in traces)


def test_nothing_is_asked_of_a_network(run, tmp_path):
    page = page_of([run], tmp_path)
    assert not re.findall(r"""(?:src|href)=["']?(?:https?:)?//""", page)


def test_names_are_text_not_markup(tmp_path):
    run = write_run(tmp_path / "<script>alert(1)<")
    assert "<script>alert" not in page_of([run], tmp_path)


def test_films_are_in_the_page(run, tmp_path):
    (run / "render").mkdir()
    (run / "render" / "window-open.png").write_bytes(b"sheet")
    assert "data:image/png;base64,c2hlZXQ=" in page_of([run], tmp_path)
    (run / "render" / "window-open.mp4").write_bytes(b"film")
    page = page_of([run], tmp_path)
    assert "data:video/mp4;base64,ZmlsbQ==" in page and "c2hlZXQ=" not in page


def test_the_command_writes_beside_the_run_and_replaces_its_own_page_alone(run, capsys):
    out = run / "report.html"
    assert main(["report", "--run", str(run)]) == 0 and capsys.readouterr().out == f"{out}\n"
    assert main(["report", "--run", str(run)]) == 0
    out.write_text("mine")
    assert main(["report", "--run", str(run)]) == 2 and out.read_text() == "mine"


def test_without_plotly_it_says_what_to_install(run, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "plotly", None)
    with pytest.raises(ConfigError, match="plotly") as caught:
        write_report([run], [], tmp_path / "page.html")
    assert "cmrl-jax[viz]" in caught.value.cure


def test_a_damaged_file_is_named(run, tmp_path):
    (tmp_path / "x.json").write_text("{}")
    with pytest.raises(ConfigError, match="x.json"):
        write_report([run], [tmp_path / "x.json"], tmp_path / "page.html")


def test_several_seeds_have_the_interval_of_the_band(tmp_path):
    runs = [
        write_run(tmp_path / f"x-seed{n}", by_k={0: 0.1 * n}, flags={"seed": n, "eval.k": "0"})
        for n in range(4)
    ]
    page = page_of(runs, tmp_path)
    _, low, high = seeds_band(np.array([[0.0], [0.1], [0.2], [0.3]]))
    assert f"{low[0]:.2f} to {high[0]:.2f} (4 seeds)" in page


def test_files_of_one_name_both_stand_there(run, tmp_path):
    files = []
    for place, rate in (("old", 0.25), ("new", 0.75)):
        path = tmp_path / place / "run" / "search-task.json"
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps(evaluation({20: rate}, adapt="search")))
        files.append(path)
    page = page_of([run], tmp_path, files)
    shown = [t["y"] for _, traces in figures_in(page) for t in traces if t.get("x") == [20]]
    assert sorted(shown) == [[0.25], [0.75]]


def test_the_command_of_an_evaluation_is_that_which_made_it(run, tmp_path):
    found = evaluation({0: 0.5}, goals=50, seed=7, adapt="search", protocol="task", draws=3)
    (run / "eval.json").write_text(json.dumps(found))
    page = page_of([run], tmp_path)
    (line,) = [line for line in page.splitlines() if "train.py eval" in line]
    for flag in ("--seed 7", "--adapt search", "--protocol task", "--eval-seeds 3"):
        assert flag in line
    assert "--z" not in line


def test_films_of_training_are_in_the_page_too(run, tmp_path):
    for steps in (900, 1000):
        folder = run / "films" / str(steps)
        folder.mkdir(parents=True)
        (folder / "window-open.png").write_bytes(str(steps).encode())
    page = page_of([run], tmp_path)
    newest, older = (base64.b64encode(x).decode() for x in (b"1000", b"900"))
    assert newest in page and older not in page and "1,000 steps, window-open" in page


def test_the_users_own_configurations_are_no_presets(tmp_path, monkeypatch):
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "foo.yaml").write_text("model:\n  hidden: 3\n")
    monkeypatch.chdir(tmp_path)
    assert preset_of(load_config("smoke")) == ("smoke.yaml", {})
