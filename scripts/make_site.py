"""Builds the site of documentation into build/site: `make docs`.

Its pages are the repository's own Markdown files that the navigation of mkdocs.yml names. They are
laid out in build/docs as they lie here, with the files that they link to, so that a link works on
the site as it does in the repository. Lines `<!-- fill: NAME -->` are filled from the commands'
parsers and from the schema. A link that leads nowhere, a name that the code has not and a page that
is not in the navigation fail the build.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal
from unittest import mock

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

import yaml  # noqa: E402

from cmrl_jax.cli.flags import COMMANDS  # noqa: E402
from cmrl_jax.cli.main import main as call  # noqa: E402
from cmrl_jax.commands import shown  # noqa: E402
from cmrl_jax.config.files import field_types, load_config  # noqa: E402
from cmrl_jax.config.schema import Config, leaves  # noqa: E402
from envs.command_line import Parser  # noqa: E402

SOURCES, SITE = ROOT / "build/docs", ROOT / "build/site"
GENERATED = "<!-- fill: (\\w+) -->"
LINK = re.compile(r"\]\(([^()\s]+)\)|(?:src|href)=\"([^\"]+)\"")
# What is no prose: fenced blocks, and code in a line.
CODE = re.compile(r"^```.*?^```|``.+?``|`[^`]+`", re.MULTILINE | re.DOTALL)


class Parsed(BaseException):
    """What a command's own parser made of its words; raised so that nothing is run."""

    def __init__(self, parser: argparse.ArgumentParser, flags: Any, rest: list[str]):
        super().__init__(parser.prog)
        self.parser, self.flags, self.rest = parser, flags, rest


def parsed(run: Callable[[], Any], is_parsed: bool = True) -> Parsed:
    """What `run`, a call of a command, has parsed: it goes no further.

    Args:
        is_parsed: False for the parser alone, whatever it was given.
    """
    parse = Parser.parse_known_args

    def hook(parser: Any, words: Any = None, namespace: Any = None) -> Any:
        raise Parsed(parser, *(parse(parser, words, namespace) if is_parsed else (None, [])))

    with mock.patch.object(Parser, "parse_known_args", hook):
        try:
            run()
        except Parsed as found:
            return found
    raise RuntimeError("it has parsed nothing")


def parser_of(command: str) -> argparse.ArgumentParser:
    """The parser of a command of train.py."""
    with mock.patch.object(sys, "argv", ["train.py"]):
        return parsed(lambda: call([command]), is_parsed=False).parser


def pages() -> list[Path]:
    """The pages of the navigation, from the root of the repository."""
    left, found = [yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]], []
    while left:
        entry = left.pop(0)
        if isinstance(entry, str):
            found.append(Path(entry))
        else:
            left[:0] = entry if isinstance(entry, list) else entry.values()
    return found


def links(text: str) -> list[str]:
    """Links of a page to files, without what is said of a place in them."""
    found = [a or b for a, b in LINK.findall(CODE.sub("", text))]
    targets = [link.partition("#")[0] for link in found if not re.match(r"[a-z]+:", link)]
    return [target for target in targets if target]


def broken(page: Path) -> list[str]:
    """Links of a page that lead to no file."""
    text = (ROOT / page).read_text()
    return [link for link in links(text) if not (ROOT / page.parent / link).is_file()]


def stage() -> None:
    """Lays the pages out, with what they link to, and fills those that are generated."""
    shutil.rmtree(SOURCES, ignore_errors=True)
    found = pages()
    inside = {p.relative_to(ROOT) for p in (ROOT / "docs").rglob("*.md")}
    if outside := sorted(str(page) for page in inside - set(found)):
        raise SystemExit(f"error: {outside[0]} is in no navigation\nfix: name it in mkdocs.yml")
    for page in found:
        if bad := broken(page):
            raise SystemExit(f"error: {page}: {bad[0]} is no file\nfix: mend the link")
        text = (ROOT / page).read_text()
        for link in links(text):
            source = Path(os.path.normpath(page.parent / link))
            if source.suffix != ".md":
                _put(source, (ROOT / source).read_bytes())
        filled = re.sub(GENERATED, lambda name: GENERATORS[name[1]](), text)
        _put(page, bars(filled).encode())
    _put(Path("docs/site.css"), (ROOT / "docs/site.css").read_bytes())


def _put(place: Path, content: bytes) -> None:
    target = SOURCES / place
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(content)


def bars(text: str) -> str:
    """A page without the mark before a bar in code of a table: GitHub needs it, a site shows it."""
    return re.sub(r"^\|.*", lambda row: _bars(row[0]), text, flags=re.MULTILINE)


def _bars(row: str) -> str:
    return re.sub("`[^`]*`", lambda code: code[0].replace("\\|", "|"), row)


def commands_page() -> str:
    """Every flag of every command, from the parser that reads it."""
    return "\n".join(line for command in COMMANDS for line in _command(command))


def _command(command: str) -> Iterator[str]:
    parser = parser_of(command)
    keys = {f"--{name}" for name, *_ in leaves(Config())}  # of the other page
    yield from (f"## {command}", "", f"{parser.description or ''}", "")
    for group in parser._action_groups:
        actions = [
            action
            for action in group._group_actions
            if action.help != argparse.SUPPRESS and not keys & set(action.option_strings)
        ]
        actions = [action for action in actions if "--help" not in action.option_strings]
        if not actions:
            continue
        named = (group.title or "") not in ("options", "positional arguments")
        yield from ((f"**{group.title}**", "") if named else ())
        yield from ("| flag | meaning |", "| --- | --- |")
        for action in actions:
            metavar = f" {action.metavar}" if action.metavar and action.nargs != 0 else ""
            name = f"`{', '.join(action.option_strings)}{metavar}`{{ .flag }}"
            must = " (must be given)" if action.required else ""
            yield f"| {_cell(name)} | {_cell((action.help or '') % vars(action))}{must} |"
        yield ""


def _cell(text: str) -> str:
    """Text in a table: neither a column's end nor a place's name for Markdown or HTML."""
    for mark, written in (("|", "\\|"), ("<", "&lt;"), ("[", "\\["), ("*", "\\*")):
        text = text.replace(mark, mark if "`" in text and mark != "|" else written)
    return text


def configuration_page() -> str:
    """Every key of the schema, section by section, with its default, bounds and text."""
    lines, last = [], None
    for name, f, default in leaves(Config()):
        section = name.rpartition(".")[0]
        if section != last:
            lines += ["", f"## {section or 'The run'}", ""]
            lines += ["| key | default | values | meaning |", "| --- | --- | --- | --- |"]
            last = section
        written = shown(default) or "(none)"
        row = (f"`{name}`{{ .flag }}", f"`{written}`", _values(name, f), _cell(f.metadata["doc"]))
        lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines)


def _values(name: str, f: Any) -> str:
    """What a key may have, in words."""
    owner: Any = Config
    for section in name.split(".")[:-1]:
        owner = field_types(owner)[section]
    hint = field_types(owner)[f.name]
    if typing.get_origin(hint) is Literal:
        return ", ".join(f"`{word}`" for word in typing.get_args(hint))
    items = typing.get_args(hint) or (hint,)
    kind = {bool: "`true`, `false`", int: "whole number", float: "number", str: "text"}[items[0]]
    if items[0] not in (int, float):
        return "names" if len(items) > 1 else kind
    if len(items) > 1:
        count = "" if items[-1] is ... else f"{len(items)} "
        kind = f"{count}{kind}s"
    low, above, high = (f.metadata[bound] for bound in ("low", "above", "high"))
    bounds = f" above {above}" if above is not None else f" from {low}"
    return kind + bounds + (f" to {high:,}" if high is not None else "")


def presets_page() -> str:
    """What each file in configs/ sets otherwise than the defaults, which are ml4.yaml's."""
    lines, usual = [], dict((name, value) for name, _, value in leaves(Config()))
    for path in sorted((ROOT / "configs").glob("*.yaml")):
        changed = [
            f"`{name}: {shown(value) or '[]'}`"
            for name, _, value in leaves(load_config(path.stem))
            if value != usual[name] and name != "name"
        ]
        lines.append(f"| `{path.name}`{{ .flag }} | {', '.join(changed) or 'nothing'} |")
    return "\n".join(["| file | keys |", "| --- | --- |", *lines])


GENERATORS: dict[str, Callable[[], str]] = {
    "commands": commands_page,
    "configuration": configuration_page,
    "presets": presets_page,
}


def build() -> int:
    """Lays out and builds; returns the exit code."""
    stage()
    shutil.rmtree(SITE, ignore_errors=True)
    program = Path(sys.executable).with_name("zensical")
    if not program.is_file():
        raise SystemExit("error: zensical is not installed\nfix: pip install 'cmrl-jax[docs]'")
    command = [program, "build", "--clean", "--strict", "--config-file", "mkdocs.yml"]
    code = subprocess.run(command, cwd=ROOT, check=False).returncode
    if code == 0:
        print(f"{len(pages())} pages: {SITE / 'index.html'}")
    return code


if __name__ == "__main__":
    sys.exit(build())
