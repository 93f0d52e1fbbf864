"""What `test_fuzz.py` tries: YAML documents, and command lines with flags and paths of any kind."""

import contextlib
import io
import re
from pathlib import Path

import yaml
from hypothesis import strategies as st

from cmrl_jax.cli import main as cli
from cmrl_jax.config.files import to_dict
from cmrl_jax.config.schema import Config, leaves

ROOT = Path(cli.__file__).parents[2]
CONFIGS = sorted(path.read_text() for path in ROOT.glob("configs/*.yaml"))
DEFAULTS = {name: value for name, _, value in leaves(Config())}
SECTIONS = [key for key, value in to_dict(Config()).items() if isinstance(value, dict)]

CHARACTERS = (
    "aexz019 _-+.:,;#'\"[]{}()&*!|>%@`?~=<\\$\t\n\r\0\x1b\x7f\x85\xa0é٣\u2028\ufeff\ud83d😀"
)
TEXT = st.lists(st.sampled_from(CHARACTERS), max_size=6).map("".join)
NUMBERS = st.one_of(
    st.integers(0, 12).map(str),
    st.integers(-1, 2**70).map(str),
    st.floats().map(repr),
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
    "drawer-open window-close drawer-open,window-open [drawer-open] drawer-opn one-hot -h".split()
    + ["", " ", "a b", "it's", '"', "a: b", "a #b", "é", "\ud83d", "\u2028", "\x1b[2J", "x" * 5000]
    + ["*x", "&x 3", "!!int 3", "!!float x", "!foo 1", "!!set {a}", "!!python/name:os.getcwd"]
    + ["&x [1, *x]", "{<<: *x}", "[*x, *x]", "'3'", '"\\0"', '"\\UFFFFFFFF"', '"\\uD800"', "[" * 99]
)
VALUES = st.one_of(NUMBERS, WORDS, TEXT)

# YAML documents -----------------------------------------------------------------------------------

SNIPPETS = TEXT | st.sampled_from(
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
)
KEYS = st.sampled_from([*DEFAULTS, *SECTIONS]) | WORDS
NAMES = st.sampled_from([key.rpartition(".")[2] for key in DEFAULTS] + SECTIONS) | WORDS
LEAVES = st.one_of(st.none(), st.none(), NUMBERS, WORDS, st.integers(), st.floats(), st.booleans())
INDENTS = st.sampled_from([" ", "  ", "\t", "- ", "? ", ": "])
STYLES = st.sampled_from([True, False, None])
EDITS = st.sampled_from("value value key line drop twice swap indent character".split())
ENCODINGS = st.sampled_from(["utf-8"] * 8 + ["utf-8-sig", "utf-16", "utf-16-le"])


@st.composite
def trees(draw) -> str:
    """Keys of the schema with their defaults or values of any kind, in blocks or in brackets."""
    data: dict = {}
    for _ in range(draw(st.integers(1, 5))):
        key, value = draw(KEYS), draw(LEAVES)
        value = DEFAULTS.get(key) if value is None else value
        value = list(value) if isinstance(value, tuple) else value
        shape = draw(st.integers(0, 9))
        value = {7: [value], 8: [value, value], 9: {key: value}}.get(shape, value)
        section, _, name = key.rpartition(".")
        owner = data.setdefault(section, {}) if section else data
        if isinstance(owner, dict):
            owner[name] = value
    return yaml.safe_dump(data, default_flow_style=draw(STYLES))


def edited(draw, lines: list[str]) -> list[str]:
    """Lines of YAML after one edit, as an editor's slip or a user's try would make it."""
    edit, at = draw(EDITS), draw(st.integers(0, len(lines) - 1))
    name, colon, rest = lines[at].partition(":")
    if edit == "value":
        lines[at] = f"{name}: {draw(VALUES)}"
    elif edit == "key":
        lines[at] = " " * (len(name) - len(name.lstrip())) + draw(NAMES) + colon + rest
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
        lines[at] = draw(INDENTS) + lines[at]
    else:
        cut, end = draw(st.integers(0, len(lines[at]))), draw(st.integers(0, 2))
        lines[at] = lines[at][:cut] + draw(SNIPPETS) + lines[at][cut + end :]
    return lines


@st.composite
def documents(draw) -> bytes:
    """A tree, or a config of the repository from some key on, after up to four edits."""
    text = draw(trees())
    if draw(st.booleans()):
        sections = re.split(r"\n\n+(?=\w)", draw(st.sampled_from(CONFIGS)))
        text = "\n".join(sections[draw(st.integers(0, len(sections) - 1)) :])
    for _ in range(draw(st.sampled_from([0, 1, 1, 1, 2, 4]))):
        text = "\n".join(edited(draw, text.split("\n") if text else [""]))
    return text.encode(draw(ENCODINGS), "surrogatepass")


# Command lines ------------------------------------------------------------------------------------

PARTS = st.sampled_from(["r", "new", "file", "..", ".", "x" * 300, "é", "", "a\0b"])
HARD = st.sampled_from(
    ["", " ", "a b", "a\nb", "\t", "é", "\udcff", "a\0b", "\0", "x" * 300, "d/" + "x" * 300]
    + ["x" * 300 + "/y", "x/" * 2500 + "y", "../" * 3 + "x", "r/../r", "new/../r", "r\0"]
)
# Below the working directory and at most three above it, but for devices that keep nothing.
PATHS = st.one_of(
    st.sampled_from(
        "r r/ r/config.yaml flat cut empty old file file/x x.npz round round/x loose loose/x . .. "
        "../x new new/x.json new/a/b.png runs runs/* r* * ** [ [a ? ~ ~/x ~nosuch/x $HOME - -- "
        "/dev/null /dev/null/x /dev/full /proc/self/x ml4.yaml smoke.yaml configs/ml4.yaml".split()
    ),
    HARD,
    HARD,
    TEXT,
    st.lists(PARTS, max_size=3).map(lambda parts: "./" + "/".join(parts)),
)
WORDS_OF_FLAGS = VALUES.map(lambda text: text.replace("/", ""))  # no path by mistake
IS_PATH = re.compile(r"--(run|runs|config|json|csv|out|figure|weights|goals\.table)$")
# What lies in the working directory: name of a run -> its config.
FLAT = "{model: {net: mlp, conditioning: none}, tasks: {test: []}, eval: {k: [0], final_k: [0]}}"
RUNS = {
    "r": "seed: 3",
    "runs/ml4-20260101-000000": "",
    "flat": FLAT,  # a policy without a latent
    "cut": "sac: {lr: [",
    "empty": "",
    "old": "gone: 3",
}
USUAL = {
    "train": {"--config": ["smoke.yaml", "sac.yaml", "empty/config.yaml"]},
    "eval": {"--run": ["r", "flat"]},
    "sweep": {"--runs": ["r", "r*", "runs/*"]},
    "finetune": {"--run": ["r"], "--task": ["window-close"], "--episodes": ["3"]},
    "plot": {"--run": ["r", "flat"]},
    "report": {"--run": ["r", "flat"]},
    "bench": {},
    "render": {"--run": ["r", "flat"]},
    "goals": {},
}
SHAPES = st.sampled_from("pair pair pair pair = bare twice misspelt word".split())


def flags_of(command: str) -> list[str]:
    """Every flag that a command's help names, but --help."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        cli.main([command, "--help"])
    return sorted(set(re.findall(r"--[a-z][\w.-]*\b", said.getvalue())) - {"--help"})


FLAGS = {command: flags_of(command) for command in cli.COMMANDS}


@st.composite
def command_lines(draw, only_paths: bool = False) -> list[str]:
    """A command with what it needs, now and then without, and flags with values of any kind."""
    command = draw(st.sampled_from(cli.COMMANDS))
    words = [command] if command != "train" or draw(st.booleans()) else []
    for flag, usual in USUAL[command].items():
        if draw(st.integers(0, 9)):
            words += [flag, draw(st.sampled_from(usual))]
    names = [flag for flag in FLAGS[command] if IS_PATH.match(flag) or not only_paths]
    for _ in range(draw(st.sampled_from([1, 1, 1, 2] if only_paths else [0, 1, 1, 2, 3]))):
        flag, shape = draw(st.sampled_from(names)), draw(SHAPES)
        value = draw(PATHS if IS_PATH.match(flag) else WORDS_OF_FLAGS)
        if shape == "=":
            words.append(f"{flag}={value}")
        elif shape == "bare":
            words.append(flag)
        elif shape == "twice":
            words += [flag, value, flag, value]
        elif shape == "misspelt":
            at = draw(st.integers(2, len(flag)))
            words += [flag[:at] + draw(TEXT) + flag[at + 1 :], value]
        elif shape == "word" and not only_paths:
            words.insert(draw(st.integers(0, len(words))), value)
        else:
            words += [flag, value]
    return words
