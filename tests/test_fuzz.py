"""Whatever is typed or written ends as a config, in the program, or as one cause and one cure.

Everything before jax is imported: YAML documents against `config_io`, flags and paths against every
command. 2,000 examples, the same each time; more, and other ones, from another seed:
`FUZZ=10 pytest tests/test_fuzz.py -s --hypothesis-seed 7`.
"""

import contextlib
import io
import os
import re
import shutil
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import hypothesis.configuration
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.internal.conjecture import providers
from hypothesis.internal.constants_ast import Constants
from test_structure import LIGHT, MODULES

import cmrl_jax
from cmrl_jax import cli
from cmrl_jax.config import Config, ConfigError, leaves
from cmrl_jax.config_io import read_yaml, resolve, to_dict, to_yaml

TIMES = int(os.environ.get("FUZZ", 1))
CONFIGS = {path.name: path.read_text() for path in Path(cli.__file__).parents[1].glob("configs/*")}
KEYS = [name for name, _, _ in leaves(Config())]
SECTIONS = [key for key, value in to_dict(Config()).items() if isinstance(value, dict)]


def examples(count: int) -> settings:
    return settings(
        max_examples=count * TIMES,
        derandomize=TIMES == 1,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


class Outcomes:
    """Counts what examples end as; a refusal must be one line of cause and one of cure."""

    def __init__(self):
        self.count: Counter[str] = Counter()
        self.causes: set[str] = set()

    def refused(self, cause: str, cure: str) -> None:
        for text in (cause, cure):
            assert text.strip() and len(" ".join(text.split()).splitlines()) == 1, (cause, cure)
        assert len(cause) < 10_000
        self.count["refused"] += 1
        self.causes.add(re.sub(r"'.*'|[0-9.]+|\(.*\)", "", cause)[:40])

    def report(self, what: str, record) -> None:
        ends = ", ".join(f"{n} {name}" for name, n in self.count.most_common())
        line = f"{self.count.total()} {what}: {ends}, {len(self.causes)} different causes"
        print(line)
        record("fuzz", line)


@pytest.fixture(autouse=True)
def same_examples_each_time(tmp_path_factory, monkeypatch):
    """Hypothesis also tries constants of the modules that happen to be loaded; keeps its files."""
    hypothesis.configuration.set_hypothesis_home_dir(tmp_path_factory.mktemp("hypothesis"))
    monkeypatch.setattr(providers, "_get_local_constants", Constants)


# What users and their editors write ---------------------------------------------------------------

NUMBERS = st.one_of(
    st.integers(0, 12).map(str),
    st.integers(-1, 2**70).map(str),
    st.floats(allow_nan=True).map(repr),
    st.sampled_from(
        "0 1 -1 0.5 1e-3 1.0e-3 .5 1. 017 0x10 0b1 0o17 1:30 1_000 _1 +3 -0 1e400 .inf -.inf .nan "
        "nan inf Infinity 2147483647 2147483648 4294967296 18446744073709551616 ٣ １".split()
        + ["9" * 400, "9" * 5000, "0x" + "f" * 5000, "1e" + "9" * 5000, "1e-" + "9" * 5000]
    ),
)
WORDS = st.sampled_from(
    "true false yes no on off null ~ none mean z soft mlp c51 v cmrl all last both train heldout "
    "fresh:1 fresh: fresh:٣ posterior prior text shuffled other metaworld native mjx 2026-01-01 "
    "2026-13-45 0,1 0,1,2 1,1 , [] [0] [[0]] [ ] 64,32 {} {a:1} = << * & ! % @ ` | > - ? : # --- "
    "drawer-open window-close drawer-open,window-open [drawer-open] drawer-opn one-hot".split()
    + ["", " ", "a b", "it's", '"', "a: b", "a #b", "é", "\ud83d", "\u2028", "\x1b[2J", "x" * 5000]
    + ["*x", "&x 3", "!!int 3", "!!float x", "!foo 1", "!!set {a}", "!!python/name:os.getcwd"]
    + ["&x [1, *x]", "{<<: *x}", "[*x, *x]", "'3'", '"\\0"', '"\\UFFFFFFFF"', '"\\uD800"', "[" * 99]
)
VALUES = st.one_of(NUMBERS, WORDS, st.text(max_size=8))
SNIPPETS = st.sampled_from(
    ["---", "...", "%YAML 1.1", "%TAG ! x", "<<: *x", "<<: {seed: 3}", "<<: [{seed: 1}, {a: 2}]"]
    + ["&x", "*x", "!!map", "!foo", "? a", "? [a]\n: b", ": b", "- a", "# x", "\tseed: 1", "|", ">"]
    + [
        "sac: &x",
        "env: &e\n  loop: *e",
        "kl: *x",
        "seed: &s 3",
        "eval: {seed: *s}",
        "~: 1",
        "'': 1",
    ]
    + [
        "\ufeff",
        "\0",
        "\r",
        "\x85",
        "\u2028",
        "{",
        "}",
        "[",
        "]",
        '"',
        "'",
        ":",
        ",",
        "\ud800",
        "é",
    ]
)


@st.composite
def trees(draw) -> str:
    """Keys of the schema with values of any kind, in blocks or in brackets."""
    data: dict = {}
    for _ in range(draw(st.integers(1, 5))):
        key = draw(st.sampled_from(KEYS) | st.sampled_from(SECTIONS) | WORDS)
        like = st.just(dict((n, v) for n, _, v in leaves(Config())).get(key, 0))
        value = draw(st.one_of(like, like, NUMBERS, WORDS, st.integers(), st.floats(), st.none()))
        value = draw(st.sampled_from([value] * 6 + [[value], [value, value], {key: value}]))
        section, _, name = key.rpartition(".")
        owner = data.setdefault(section, {}) if section else data
        if isinstance(owner, dict):
            owner[name] = list(value) if isinstance(value, tuple) else value
    return yaml.safe_dump(data, default_flow_style=draw(st.sampled_from([True, False, None])))


@st.composite
def documents(draw) -> bytes:
    """A config of the repository, or a tree, after up to four edits."""
    text = draw(st.sampled_from(sorted(CONFIGS.values())) | trees())
    for _ in range(draw(st.sampled_from([0, 1, 1, 1, 2, 4]))):
        lines = text.split("\n")
        at = draw(st.integers(0, len(lines) - 1))
        edit = draw(
            st.sampled_from("value value key line drop twice swap indent character".split())
        )
        if edit == "value":
            keys = [i for i, line in enumerate(lines) if re.match(r" *\w+: .", line)]
            at = draw(st.sampled_from(keys or [at]))
            lines[at] = f"{lines[at].partition(':')[0]}: {draw(VALUES)}"
        elif edit == "key":
            name, colon, rest = lines[at].partition(":")
            names = st.sampled_from([key.rpartition(".")[2] for key in KEYS] + SECTIONS) | WORDS
            indent = " " * (len(name) - len(name.lstrip()))
            lines[at] = indent + draw(names) + colon + rest
        elif edit == "line":
            lines.insert(at, " " * draw(st.integers(0, 3)) + draw(SNIPPETS))
        elif edit == "drop":
            del lines[at]
        elif edit == "twice":
            lines.insert(draw(st.integers(0, len(lines))), lines[at])
        elif edit == "swap":
            other = draw(st.integers(0, len(lines) - 1))
            lines[at], lines[other] = lines[other], lines[at]
        elif edit == "indent":
            lines[at] = draw(st.sampled_from([" ", "  ", "\t", "- ", "? ", ": "])) + lines[at]
        else:
            cut = draw(st.integers(0, len(lines[at])))
            rest = lines[at][cut + draw(st.integers(0, 2)) :]
            lines[at] = lines[at][:cut] + draw(SNIPPETS | st.text(max_size=2)) + rest
        text = "\n".join(lines)
    encoding = draw(st.sampled_from(["utf-8"] * 8 + ["utf-8-sig", "utf-16", "utf-16-le"]))
    return text.encode(encoding, "surrogatepass")


@examples(500)
@given(document=documents())
def check_document(path: Path, outcomes: Outcomes, document: bytes) -> None:
    path.write_bytes(document)
    try:
        config = resolve(*read_yaml(path))
    except ConfigError as error:
        return outcomes.refused(error.cause, error.cure)
    outcomes.count["configs"] += 1
    path.write_text(to_yaml(config), encoding="utf-8")
    assert resolve(*read_yaml(path)) == config


def test_documents(tmp_path, record_property):
    outcomes = Outcomes()
    check_document(tmp_path / "x.yaml", outcomes)
    outcomes.report("documents", record_property)
    assert outcomes.count.total() >= 500 and min(outcomes.count.values()) > 40


# The command line ---------------------------------------------------------------------------------


class Reached(BaseException):
    """The light half is over: the program would be imported now."""


FLAT = {"model.net": "mlp", "model.conditioning": "none", "tasks.test": "", "eval.k": "0"}
RUNS = {
    "r": to_yaml(Config()),
    "runs/ml4-20260101-000000": to_yaml(Config()),
    "flat": to_yaml(resolve({}, flags=FLAT | {"eval.final_k": "0"})),  # a policy without a latent
    "cut": "sac: {lr: [",
    "empty": "",
    "old": "gone: 3",
}


class Sandbox:
    """A directory with runs and files of all sorts, two levels down, put back after each change."""

    def __init__(self, top: Path):
        self.top, self.home = top, top / "middle" / "here"
        self.restore()

    def __repr__(self) -> str:
        return "sandbox"

    def restore(self) -> None:
        os.chdir(self.top.parent)
        shutil.rmtree(self.top, ignore_errors=True)
        self.home.mkdir(parents=True)
        os.chdir(self.home)
        for run, text in RUNS.items():
            Path(run, "policy").mkdir(parents=True)
            Path(run, "config.yaml").write_text(text)
        Path("file").write_text("text")
        Path("x.npz").write_text("")
        Path("round").symlink_to("round")
        Path("loose").symlink_to("nowhere/at/all")
        self.before = self._files()

    def _files(self) -> dict[str, tuple[int, float]]:
        found = {}
        for folder, folders, names in os.walk(self.top):
            for name in (*folders, *names):
                status = os.lstat(os.path.join(folder, name))
                when = 0.0 if name in folders else status.st_mtime
                found[os.path.join(folder, name)] = (status.st_mode, when)
        return found

    def changes(self) -> set[str]:
        """What is new, gone or rewritten since `restore`."""
        return {str(Path(name).relative_to(self.home, walk_up=True))
                for name, _ in self.before.items() ^ self._files().items()}  # fmt: skip


@pytest.fixture
def sandbox(tmp_path, monkeypatch):
    """Stubs in place of every program, and files to run into."""

    def reached(*args, **kwargs):
        raise Reached

    class Stub(ModuleType):
        def __getattr__(self, name):
            if name.startswith("__"):
                raise AttributeError(name)
            return reached

    for name in MODULES:
        package, _, module = name.rpartition(".")
        if package == "envs" or (package == "cmrl_jax" and module not in LIGHT):
            monkeypatch.setitem(sys.modules, name, Stub(name))
        if package == "cmrl_jax" and module not in LIGHT:
            monkeypatch.setattr(cmrl_jax, module, Stub(name), raising=False)
    monkeypatch.chdir(tmp_path)  # and back at the end
    return Sandbox(tmp_path / "top")


PARTS = ["r", "new", "file", "..", ".", "x" * 300, "é", "", "a\0b"]
HARD = st.sampled_from(
    ["", " ", "a b", "a\nb", "\t", "é", "\udcff", "a\0b", "\0", "x" * 300, "d/" + "x" * 300]
    + ["x" * 300 + "/y", "x/" * 2500 + "y", "../" * 3 + "x", "r/../r", "new/../r", "r\0"]
)
PATHS = st.one_of(
    st.sampled_from(
        "r r/ r/config.yaml flat cut empty old file file/x x.npz round round/x loose loose/x . .. "
        "../x new new/x.json new/a/b.png runs runs/* r* * ** [ [a ? ~ ~/x ~nosuch/x $HOME - -- "
        "/dev/null /dev/null/x /dev/full /proc/self/x ml4.yaml smoke.yaml configs/ml4.yaml".split()
    ),
    HARD,
    HARD,
    st.text(max_size=6).map(lambda text: text.replace("/", "")),
    st.lists(st.sampled_from(PARTS), max_size=3).map(lambda parts: "./" + "/".join(parts)),
)
IS_PATH = re.compile(r"--(run|runs|config|json|csv|out|figure|weights|goals\.table)$")
USUAL = {
    "train": {"--config": ["smoke.yaml", "sac.yaml", "empty/config.yaml"]},
    "eval": {"--run": ["r", "flat"]},
    "sweep": {"--runs": ["r", "r*", "runs/*"]},
    "finetune": {"--run": ["r"], "--task": ["window-close"], "--episodes": ["3"]},
    "plot": {"--run": ["r", "flat"]},
    "bench": {},
    "render": {"--run": ["r", "flat"]},
    "goals": {},
}


def flags_of(command: str) -> list[str]:
    """Every flag that a command's help names."""
    help_text = io.StringIO()
    with contextlib.redirect_stdout(help_text), contextlib.suppress(SystemExit):
        cli.main([command, "--help"])
    return sorted(set(re.findall(r"--[a-z][\w.-]*\b", help_text.getvalue())))


FLAGS = {command: flags_of(command) for command in cli.COMMANDS}


@st.composite
def command_lines(draw, only_paths: bool = False) -> list[str]:
    """A command with what it needs, and flags with values of any kind; now and then neither."""
    command = draw(st.sampled_from(cli.COMMANDS))
    words = [command] if command != "train" or draw(st.booleans()) else []
    for flag, usual in USUAL[command].items():
        if draw(st.integers(0, 9)):
            words += [flag, draw(st.sampled_from(usual))]
    names = [flag for flag in FLAGS[command] if IS_PATH.match(flag) or not only_paths]
    for _ in range(draw(st.sampled_from([1, 1, 1, 2] if only_paths else [0, 1, 1, 2, 3]))):
        flag = draw(st.sampled_from(names))
        value = draw(
            PATHS if IS_PATH.match(flag) else VALUES.map(lambda text: text.replace("/", ""))
        )
        shape = draw(st.sampled_from("pair pair pair pair = bare twice misspelt word".split()))
        if shape == "pair":
            words += [flag, value]
        elif shape == "=":
            words.append(f"{flag}={value}")
        elif shape == "bare":
            words.append(flag)
        elif shape == "twice":
            words += [flag, value, flag, value]
        elif shape == "misspelt":
            at = draw(st.integers(2, len(flag)))
            words += [flag[:at] + draw(st.text(max_size=2)) + flag[at + 1 :], value]
        elif not only_paths:
            words.insert(draw(st.integers(0, len(words))), value)
    return words


def check_words(sandbox: Sandbox, outcomes: Outcomes, words: list[str]) -> None:
    """Runs one command line up to the program; a refused one must leave nothing behind."""
    said, end = io.StringIO(), "refused"
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            code = cli.main(words)
        assert code == 2, f"{code} without the program: {said.getvalue()}"
    except Reached:
        end = "in the program"
    except SystemExit as stop:
        assert stop.code == 0
        end = "helped"
    if changes := sandbox.changes():
        sandbox.restore()
    if end != "refused":
        outcomes.count[end] += 1
        return
    lines = said.getvalue().splitlines()
    assert len(lines) == 2, lines
    assert not changes, f"refused, and yet changed: {changes}, {lines}"
    outcomes.refused(lines[0].removeprefix("error: "), lines[1].removeprefix("fix: "))


check_flags = examples(1000)(given(words=command_lines())(check_words))
check_paths = examples(500)(given(words=command_lines(only_paths=True))(check_words))


@pytest.mark.parametrize(
    ("check", "least"), [(check_flags, 1000), (check_paths, 500)], ids=["flags", "paths"]
)
def test_command_lines(sandbox, record_property, request, check, least):
    outcomes = Outcomes()
    check(sandbox, outcomes)
    outcomes.report(f"command lines ({request.node.callspec.id})", record_property)
    assert outcomes.count.total() >= least
    assert min(outcomes.count[end] for end in ("refused", "in the program")) > least / 10
