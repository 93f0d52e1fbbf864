"""The pages: the site builds, links lead somewhere, and what a page has one type is accepted."""

import ast
import importlib.util
import re
import shlex
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import yaml

import cmrl_jax as cj
from cmrl_jax.cli import evaluate_flags, finetune_flags
from cmrl_jax.cli.flags import COMMANDS
from cmrl_jax.cli.main import main
from cmrl_jax.config.files import find_config, read_yaml, resolve
from cmrl_jax.config.schema import Config, leaves
from cmrl_jax.evaluation.options import check_run
from cmrl_jax.storage.run_dir import find_run
from envs.parity import __main__ as parity
from scripts.make_site import (
    GENERATORS,
    SITE,
    SOURCES,
    bars,
    broken,
    commands_page,
    configuration_page,
    links,
    pages,
    parsed,
)

ROOT = Path(__file__).parent.parent
PAGES = pages()
FENCE = re.compile(r"^ *```(\w*)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`((?:python train\.py|python -m envs|python scripts/|make) [^`]+)`")
# Of a synopsis, and words in place of others: nothing to type.
SYNOPSIS = re.compile(r"\[|\.\.\.|\||<")
PLACEHOLDER = re.compile(r"\b(X\.yaml|COMMAND|NAME|A,B)\b")


def blocks(page: Path, language: str) -> list[str]:
    """Fenced blocks of a page in a language."""
    found = FENCE.findall((ROOT / page).read_text())
    return [textwrap.dedent(text) for name, text in found if name == language]


def commands(page: Path) -> list[list[str]]:
    """Commands that a page shows, in blocks and in lines, as words, without variables before."""
    text = FENCE.sub("", (ROOT / page).read_text())
    inline = [" ".join(code.split()) for code in INLINE.findall(text)]
    lines = [code for code in inline if not SYNOPSIS.search(code)]
    for block in blocks(page, "sh"):
        lines += block.replace("\\\n", " ").splitlines()
    lines = [line for line in lines if not PLACEHOLDER.search(line)]
    found = [shlex.split(line, comments=True) for line in lines]
    for words in found:
        while words and re.match(r"[A-Z_]+=", words[0]):
            words.pop(0)
    return [words for words in found if words]


ALL = [(str(page), words) for page in PAGES for words in commands(page)]


def check_train_py(words: list[str]) -> None:
    """Whether the command's own parser, and what needs no run, take these words."""
    found = parsed(lambda: main([word for word in words if word != "--help"]))
    assert not found.rest, found.rest
    flags, command = found.flags, words[0] if words[0] in COMMANDS else "train"
    assert flags is not None
    if command == "train" and flags.config is not None:
        keys = {name for name, *_ in leaves(Config())}
        given = {name: value for name, value in vars(flags).items() if name in keys}
        resolve(*read_yaml(find_config(flags.config)), flags=given)
    elif command in ("eval", "sweep"):
        options = evaluate_flags.options_of(flags)
        if command == "eval" and flags.run.parts[0] not in ("runs", "DIR"):  # one that is kept
            check_run(options, find_run(flags.run))
    elif command == "finetune":
        finetune_flags.options_of(flags)


def check_make(words: list[str]) -> None:
    """Whether the target and the variables are the Makefile's."""
    text = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"^([a-z-]+):", text, re.MULTILINE))
    variables = set(re.findall(r"\$\(([A-Z]+)\)", text))
    for word in words:
        name, is_set, value = word.partition("=")
        assert name in (variables if is_set else targets), word
        if name == "ARGS" and words[0] == "train":
            check_train_py(["--config", "ml4.yaml", *shlex.split(value)])


@pytest.mark.parametrize(("page", "words"), ALL, ids=[f"{p}: {' '.join(w)}" for p, w in ALL])
def test_what_a_page_shows_can_be_typed(page, words, monkeypatch):
    monkeypatch.chdir(ROOT)
    program, *rest = words
    assert all(Path(word).exists() for word in rest if word.startswith("results/"))
    if program == "make":
        check_make(rest)
    elif program == "cmrl":
        check_train_py(rest)
    elif program.endswith("python") and rest[0] == "train.py":
        check_train_py(rest[1:] or ["--config", "ml4.yaml"])
    elif program.endswith("python") and rest[:2] == ["-m", "envs.parity"]:
        found = parsed(lambda: parity.main(rest[2:]))
        assert not found.rest, found.rest
    elif program.endswith("python") and rest[0].endswith(".py"):
        assert (ROOT / rest[0]).is_file(), rest[0]


def test_the_scan_sees_commands():
    shown = {" ".join(words[:3]) for _, words in ALL}
    assert {"make train", "python train.py eval", "python -m envs.parity"} <= shown
    assert len([words for page, words in ALL if page.startswith("docs/howto/")]) > 20


@pytest.mark.parametrize("page", sorted(p.relative_to(ROOT) for p in ROOT.glob("docs/**/*.md")))
def test_every_page_is_in_the_navigation(page):
    assert page in PAGES


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_links_lead_to_files(page):
    assert not broken(page)


def test_links_in_code_are_none():
    text = "[a](b.md#c) ![p](q.png) `[x](y.md)`\n```\n[u](v.md)\n```\n[w](https://w) [s](#here)\n"
    assert links(text) == ["b.md", "q.png"]


def test_bars_in_code_of_a_table_need_no_mark():
    assert bars("| `a\\|b` | c\\|d |\n`e\\|f`\n") == "| `a|b` | c\\|d |\n`e\\|f`\n"


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_snippets_use_what_there_is(page):
    """Blocks of Python parse, and take from `cj` what `import cmrl_jax` offers."""
    for block in blocks(page, "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "cj":
                assert node.attr in cj.__all__, node.attr


def test_the_task_that_a_page_adds_is_the_one_that_is_tested():
    tested = (ROOT / "tests/envs/test_fifth_task.py").read_text()
    page = Path("docs/howto/add-a-task.md")
    [file], [line] = blocks(page, "python"), blocks(page, "text")
    assert file in tested and line.strip() in tested


def test_references_have_every_key_and_flag():
    configuration, flags = configuration_page(), commands_page()
    assert not [name for name, *_ in leaves(Config()) if f"`{name}`" not in configuration]
    assert not [name for name in COMMANDS if f"## {name}\n" not in flags]
    for word in ("`--adapt A`", "`--text SENTENCE`", "`--episodes N`", "`--seeds N`"):
        assert word in flags
    assert "`--sac.gamma" not in flags  # it stands on the other page


def test_citation_says_what_the_package_says():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0" and citation["message"] and citation["authors"]
    assert citation["version"] == cj.__version__
    assert citation["license"] == "MIT" and citation["type"] == "software"
    assert cj.__version__ in (ROOT / "CHANGELOG.md").read_text()


@pytest.mark.skipif(importlib.util.find_spec("zensical") is None, reason="without the extra docs")
def test_the_site_builds_strictly():
    command = [sys.executable, "scripts/make_site.py"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    for page in PAGES:
        name = "index" if page.stem == "README" else page.stem
        assert (SITE / page.parent / f"{name}.html").is_file(), page
    reference = (SOURCES / "docs/reference/configuration.md").read_text()
    assert GENERATORS["configuration"]() in reference
    assert "mjx\\|native" not in (SITE / "index.html").read_text()
    assert "register_environment" in (SITE / "docs/reference/python.html").read_text()
