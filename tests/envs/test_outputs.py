"""Output files of all commands: whole or not at all, and nobody's but their own command's."""

import contextlib
import json
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cmrl_jax.cli import plot_flags, render_flags
from cmrl_jax.cli.flags import Parser, parse
from cmrl_jax.cli.main import main
from cmrl_jax.config.files import load_config, to_yaml
from cmrl_jax.config.schema import ConfigError
from envs import goal_sets
from envs.command_line import brief
from envs.outputs import check_output, replacing, save_figure, write_json, written_by
from envs.parity import __main__ as parity
from envs.render import picture
from envs.tasks import METAWORLD_TASKS as TASKS

MARK = written_by("eval")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working directory, in which `run` is a run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text(to_yaml(load_config("smoke.yaml")))
    return tmp_path


# What may be replaced ---------------------------------------------------------------------------


def test_a_command_replaces_its_own_files_alone(tmp_path):
    path = tmp_path / "new" / "f.json"
    check_output(path, "--json", MARK)
    assert not path.parent.exists()  # asked, and left to the command to write
    write_json(path, "eval", {"a": 1})
    assert json.loads(path.read_text()) == {"origin": MARK, "a": 1}
    check_output(path, "--json", MARK)
    with pytest.raises(ValueError, match="this command did not write it\n.*--force"):
        check_output(path, "--json", written_by("sweep"))
    check_output(path, "--json", written_by("sweep"), force=True)
    path.write_bytes(b"")
    check_output(path, "--json", written_by("sweep"))  # nothing is lost with an empty file


@pytest.mark.parametrize("size", [10, 10**6])
def test_the_mark_is_looked_for_at_both_ends(tmp_path, size):
    path, filler = tmp_path / "f", b"x" * size
    for content in (MARK.encode() + filler, filler + MARK.encode()):
        path.write_bytes(content)
        check_output(path, "--json", MARK)
    path.write_bytes(filler)
    with pytest.raises(ValueError, match="did not write it"):
        check_output(path, "--json", MARK)


@pytest.mark.parametrize("ending", ["png", "svg", "pdf", "eps"])
def test_a_picture_says_who_drew_it(tmp_path, ending):
    from matplotlib.figure import Figure

    path = tmp_path / f"f.{ending}"
    Figure().savefig(path)
    with pytest.raises(ValueError, match="did not write it"):
        check_output(path, "--out", written_by("plot"))
    save_figure(Figure(), path, "plot")
    check_output(path, "--out", written_by("plot"))


# How files are written --------------------------------------------------------------------------


def test_a_file_is_replaced_whole_or_stays(tmp_path):
    path = tmp_path / "f"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), replacing(path) as part:
        part.write_text("ne")
        raise KeyboardInterrupt
    assert path.read_text() == "old" and [path] == list(tmp_path.iterdir())
    with replacing(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new" and [path] == list(tmp_path.iterdir())


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "there").mkdir()
    link, target = tmp_path / "link", tmp_path / "there" / "f"
    link.symlink_to(target)
    for _ in range(2):
        check_output(link, "--json", MARK)
        write_json(link, "eval", {})
    assert link.is_symlink() and json.loads(target.read_text()) == {"origin": MARK}


def test_a_pipe_is_written_to_as_it_is(tmp_path):
    read, write = os.pipe()
    path = Path(f"/dev/fd/{write}")
    check_output(path, "--json", MARK)
    write_json(path, "eval", {})
    os.close(write)
    with open(read, encoding="utf-8") as file:
        assert json.load(file) == {"origin": MARK}
    check_output(Path("/dev/null"), "--json", MARK)


def test_a_name_as_long_as_can_be(tmp_path):
    path = tmp_path / ("n" * 250 + ".json")
    check_output(path, "--json", MARK)
    write_json(path, "eval", {})
    assert path.is_file()


@pytest.mark.parametrize(
    "path", ["", "n" * 300, "new/" + "n" * 300, "new/../here", "file/f.json", "loop"]
)
def test_what_cannot_be_written_is_two_lines(tmp_path, path):
    (tmp_path / "file").write_text("")
    (tmp_path / "loop").symlink_to("loop/x")
    (tmp_path / "here").mkdir()
    for refused in (
        lambda: check_output(tmp_path / path, "--json", MARK),
        lambda: write_json(tmp_path / path, "eval", {}),
    ):
        with pytest.raises(ValueError, match="cannot write") as error:
            refused()
        cause, cure = str(error.value).split("\n")
        assert brief(tmp_path / path) in cause and "--json" in cure


@pytest.mark.parametrize("name", ["new/" + "n" * 300, "new/../here", "new/a/b.json"])
def test_a_check_leaves_nothing_behind(tmp_path, name):
    (tmp_path / "here").mkdir()
    with contextlib.suppress(ValueError):
        check_output(tmp_path / name, "--json", MARK)
    assert [path.name for path in tmp_path.iterdir()] == ["here"]


# Every command ----------------------------------------------------------------------------------


def foreign(*names):
    for name in names:
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("somebody's own")


COMMANDS = {
    "eval --run run --json F": "F",
    "eval --run run --csv F": "F",
    "sweep --runs run --json F": "F",
    "sweep --runs run --csv F": "F",
    "finetune --run run --task window-close --json F": "F",
    "finetune --run run --task window-close --figure F.png": "F.png",
    "plot --run run": "run/plots/success.png",
    "plot --run run --out D": "D/z.png",
    "render --run run --out D": "D/window-open.mp4",
    "render --run run": "run/render/drawer-open.png",
    "bench --json F": "F",
    "bench": "bench.json",
    "goals --figure F.png": "F.png",
}


@pytest.mark.parametrize("words", COMMANDS)
def test_no_command_replaces_what_it_did_not_write(here, refused, words):
    foreign(COMMANDS[words])
    cause, cure = refused(*words.split())
    assert f"{COMMANDS[words]} is there, and this command did not write it" in cause
    assert "--force" in cure
    assert Path(COMMANDS[words]).read_text() == "somebody's own"


@pytest.mark.parametrize(
    ("program", "words", "file"),
    [
        (parity, ["--json", "F"], "F"),
        (picture, ["--out", "D"], "D/window.png"),
        (goal_sets, ["--out", "F"], "F"),
    ],
)
def test_no_program_of_envs_does(here, capsys, program, words, file):
    foreign(file)
    assert program.main(words) == 2
    cause, cure = capsys.readouterr().err.splitlines()
    assert f"{file} is there, and this command did not write it" in cause and "--force" in cure
    assert Path(file).read_text() == "somebody's own"


def test_goal_sets_are_written_again(here):
    for _ in range(2):
        assert goal_sets.main(["--out", "F.npz"]) == 0
    assert Path("F.npz").read_bytes() == goal_sets._PACKAGED.read_bytes()


def test_force_is_handed_on(here, replace_module):
    foreign("F", "D/window-open.mp4")
    made = []
    fake = SimpleNamespace(main=lambda **kwargs: made.append(kwargs) or 0)
    replace_module("cmrl_jax.bench.main", fake)
    assert main(["bench", "--json", "F", "--force"]) == 0 and made
    flags = render_flags.add_flags(Parser())
    words = ["--run", "run", "--out", "D"]
    with pytest.raises(ConfigError):
        render_flags.options_of(parse(flags, words))
    assert render_flags.options_of(parse(flags, [*words, "--force"]))[2] == Path("D")


def test_figures_of_goals_are_drawn_again_and_forced_without_a_table_made(here, monkeypatch):
    foreign("F.png")
    monkeypatch.setattr(
        "cmrl_jax.text.goal_builder.build", lambda *args: pytest.fail("a table is made")
    )
    assert main(["goals", "--figure", "F.png", "--force"]) == 0
    assert main(["goals", "--figure", "F.png"]) == 0
    assert Path("F.png").read_bytes().startswith(b"\x89PNG")


def test_films_say_who_made_them(here):
    from PIL import Image

    from cmrl_jax.analysis.film import Episode, Film, write_sheet, write_video

    blank = SimpleNamespace(take=lambda episode, step: np.zeros((352, 480, 3), np.uint8))
    episode = Episode("e", np.zeros((3, 10)), np.zeros(3, bool), 0.0)
    film = Film(TASKS[0], "caption", np.zeros(3), (episode,))
    for write, path in (
        (lambda path: write_video(film, blank, 1, path), Path("f.mp4")),  # pyright: ignore
        (lambda path: write_sheet(film, blank, path), Path("f.png")),  # pyright: ignore
    ):
        write(path)
        check_output(path, "--out", written_by("render"))
    with Image.open("f.png") as sheet:
        assert sheet.size[0] > 480
    assert {p.name for p in Path().iterdir()} == {"run", "f.mp4", "f.png"}


def test_plots_are_listed(here):
    """What `plot` may draw is what is asked about before it begins."""
    (here / "run" / "metrics.csv").write_text(
        "iteration,env_steps,train/window-open/return\n0,9,1\n"
    )
    for _ in range(2):
        assert main(["plot", "--run", "run"]) == 0  # its own are drawn again
    drawn = {path.name for path in (here / "run" / "plots").iterdir()}
    assert {"success.png", "returns.png"} <= drawn <= set(plot_flags.PICTURES)
