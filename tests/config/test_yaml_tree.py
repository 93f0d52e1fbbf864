"""YAML beyond trees: what YAML users write is read as YAML has it, or refused by file and line."""

import time
from pathlib import Path

import pytest
import yaml

from cmrl_jax.config.files import load_config, read_yaml, resolve
from cmrl_jax.config.schema import Config, ConfigError
from cmrl_jax.config.yaml_tree import MAX_DEPTH, MAX_VALUES, read_tree
from cmrl_jax.text.goal_builder import read_prompts


@pytest.fixture
def tree(tmp_path):
    """Reads YAML text or bytes from a file `x.yaml`."""

    def read(text: str | bytes) -> tuple[dict, dict]:
        path = tmp_path / "x.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_tree(path)

    return read


SAME_AS_PYYAML = [
    "a: &x [1, 2]\nb: *x",
    "a: &x 3\nb: {c: *x}",
    "a: &x {b: 1}\nc: {<<: *x, d: 2}",
    "a: &x {b: 1}\nc: {<<: *x, b: 2}",
    "a: &x {b: 1}\nc: {b: 2, <<: *x}",  # own keys win wherever << stands
    "a: &x {b: 1}\nc: &y {b: 2, d: 3}\ne: {<<: [*x, *y]}",  # the earlier wins
    "a: &x {b: 1}\nc: &y {<<: *x, d: 3}\ne: {<<: *y, f: 4}",
    "a: {<<: {b: 1}, c: 2}",
    "a: {<<: [], c: 2}",
    "a: {<<: {b: {c: 1}}, b: {d: 2}}",  # a merge is shallow
    "&k a: 1\nb: {*k : 2}",
    "a: 1_000\nb: -0\nc: .5\nd: ~\ne: on\nf: 0o17\ng: 1e3\nh: '017'\ni: 007.5",
    "a: !!str 017\nb: !!float 3\nc: !!int '4'\nd: ! 5\ne: !!null\nf: !!map {g: !!seq [1]}",
    "a: 2026-01-02\nb: 2026-01-02 03:04:05",
    "? a\n: 1\n? b\n",
    "%YAML 1.1\n---\na: 1\n...\n",
    "\ufeffa: 1\r\nb:\r\n  c: é\r\n",
    "--- # nothing",
    "",
]


@pytest.mark.parametrize("text", SAME_AS_PYYAML)
def test_is_read_as_yaml_has_it(tree, text):
    assert tree(text)[0] == (yaml.safe_load(text) or {})


def test_a_name_may_be_given_to_a_second_anchor(tree):
    """As YAML 1.1 has it: an alias stands for the last anchor before it. PyYAML refuses."""
    assert tree("a: &x 1\nb: *x\nc: &x 2\nd: *x")[0] == {"a": 1, "b": 1, "c": 2, "d": 2}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_encodings_with_their_marks(tree, encoding):
    assert tree("name: Zoë\r\nseed: 3".encode(encoding))[0] == {"name": "Zoë", "seed": 3}


def test_lines_are_those_where_a_key_is_written(tree):
    text = "a: &x\n  b: 1\n  c: 2\nd:\n  <<: *x\n  c: 3\ne: *x\n"
    lines = {"a": 1, "a.b": 2, "a.c": 3, "d": 4, "d.b": 2, "d.c": 6, "e": 7, "e.b": 2, "e.c": 3}
    assert tree(text)[1] == lines


def test_a_mistake_in_a_merged_mapping_names_its_own_line(refused, tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("eval:\n  <<: &e\n    goal: 3\n  seed: 1\n")
    assert refused("--config", str(path))[0] == f"unknown key 'eval.goal' ({path}:3)"


def test_anchors_and_merge_keys_make_a_config(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text(
        "encoder: {hidden: &h [32, 32]}\nmodel: {mlp_hidden: *h}\n"
        "eval: {<<: [{goals: 3, seed: 4}, {seed: 5}], goals: 6}\n"
    )
    config = load_config(path)
    assert config.model.mlp_hidden == config.encoder.hidden == (32, 32)
    assert (config.eval.goals, config.eval.seed, config.eval.every) == (6, 4, 0.1)


def chain(first: str, link: str, links: int = 9) -> str:
    """Keys each of which has ten aliases of the one before: 10^links values."""
    keys = [f"k0: &k0 {first}"]
    for i in range(1, links + 1):
        keys.append(f"k{i}: &k{i} " + link.replace("@", ", ".join([f"*k{i - 1}"] * 10)))
    return "\n".join(keys)


# YAML text, what the cause must say, what the cure must say.
REFUSED = [
    ("env: &e\n  loop: *e", "the alias *e stands inside what it names (x.yaml:2)", "write out"),
    ("env: &e [1, *e]", "the alias *e stands inside what it names (x.yaml:1)", "write out"),
    ("env: &e\n  <<: *e", "the alias *e stands inside what it names (x.yaml:2)", "write out"),
    ("a: *e", "x.yaml:1 is not valid YAML: found undefined alias 'e'", "check"),
    (chain("[x]", "[@]"), f"the aliases of x.yaml unfold to over {MAX_VALUES}", "write out"),
    (chain("{x: 1}", "{<<: [@]}"), f"of x.yaml unfold to over {MAX_VALUES}", "write out"),
    (chain("[x]", "[@]", 200), "unfold to over", "write out"),
    ("a: &k0 [x]\n" + "\n".join(f"b{i}: &k{i} [*k{i - 1}]" for i in range(1, 1500)),
     f"nested over {MAX_DEPTH} deep (x.yaml:", "sections of keys"),
    ("a: &k0 {x: 1}\n" + "\n".join(f"b{i}: &k{i} {{<<: *k{i - 1}}}" for i in range(1, 1500)),
     f"nested over {MAX_DEPTH} deep (x.yaml:", "sections of keys"),
    ("seed: " + "[" * 5000, f"nested over {MAX_DEPTH} deep (x.yaml:1)", "sections of keys"),
    ("{a: " * 5000, f"nested over {MAX_DEPTH} deep (x.yaml:1)", "sections of keys"),
    ("- " * 5000, f"nested over {MAX_DEPTH} deep (x.yaml:1)", "sections of keys"),
    ("a: 1\nb: {<<: 3}", "the merge key << takes over no mapping (x.yaml:2)", "alias"),
    ("a: {<<: [{b: 1}, 3]}", "the merge key << takes over no mapping", "alias"),
    ("a: {<<: {b: 1}, <<: {c: 2}}", "key 'a.<<' stands twice", "keep one"),
    ("a: {<<: {b: 1, b: 2}}", "key 'a.b' stands twice", "keep one"),
    ("a: <<", "'a' has a value of a kind no key takes: <<", "quotes"),
    ("a: =", "'a' has a value of a kind no key takes: =", "quotes"),
    ("seed: 1\n---\nseed: 2", "a second document begins at x.yaml:2", "keep one"),
    ("a: !!python/object:os.system {b: 1}", "tag !!python/object:os.system makes 'a'", "remove"),
    ("a: !foo [1]", "the tag !foo makes 'a' a kind no key takes (x.yaml:1)", "remove it"),
    ("a: !!set {b}", "the tag !!set makes 'a'", "remove it"),
    ("a: !!omap [b: 1]", "the tag !!omap makes 'a'", "remove it"),
    ("!foo\na: 1", "the tag !foo makes 'the file'", "remove it"),
    ("!foo a: 1", "the tag !foo makes 'the key a'", "remove it"),
    ("a: !!binary aGk=", "the tag !!binary makes 'a'", "remove it"),
    ("a: !!int ''", "the tag !!int makes 'a'", "remove it"),
    ("a: !!float x", "the tag !!float makes 'a'", "remove it"),
    ("a: !!bool x", "the tag !!bool makes 'a'", "remove it"),
    ("a: !!timestamp x", "the tag !!timestamp makes 'a'", "remove it"),
    ("a: !!null x", "the tag !!null makes 'a'", "remove it"),
    ("a: !!int |\n  017\n", "YAML reads 017\\n as another number", "leading 0"),
    ("a: 2026-13-45", "'a' has a value of a kind no key takes: 2026-13-45", "quotes"),
    ("? [a, b]\n: 3", "a key is no word (x.yaml:1)", "`key: value`"),
    ("a:\n  ? {b: c}\n  : 3", "a key of 'a' is no word (x.yaml:2)", "`key: value`"),
    ("? \n: 3", "a key is empty (x.yaml:1)", "`key: value`"),
    ("a: {' ': 3}", "a key of 'a' is empty", "`key: value`"),
    ("017: 3", "YAML reads 017 as another number", "leading 0"),
    ("a: 1\nb: '\0'", "x.yaml:2 holds U+0000", "remove it"),
    ("a: \"\\UFFFFFFFF\"", "x.yaml:1 is not valid YAML: chr() arg", "escapes"),
    ("%YAML 1." + "9" * 5000 + "\n---\na: 1", "x.yaml:1 is not valid YAML: Exceeds", "numbers"),
    ("%YAML 2.0\n---\na: 1", "incompatible YAML document", "check"),
    ("a: " + "9" * 10_000, "'a' has a value of a kind no key takes: 99999", "write a number"),
    ("a: 0x" + "f" * 5000, "YAML reads 0xffff", "plain decimal"),
    ("a: 0x10", "YAML reads 0x10 as another number", "plain decimal"),
    ("a: -0b1", "YAML reads -0b1 as another number", "plain decimal"),
    ("# x\n" * 2_600_000, "x.yaml is over 256 KiB", "settings"),
    ("~", "holds no mapping", "`key: value`"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "cause", "cure"), REFUSED, ids=[f"{i}: {r[0][:30]}" for i, r in enumerate(REFUSED)]
)
def test_is_refused_in_two_lines_and_at_once(tmp_path, monkeypatch, text, cause, cure):
    monkeypatch.chdir(tmp_path)
    Path("x.yaml").write_text(text)
    start = time.process_time()
    with pytest.raises(ConfigError) as error:
        read_tree(Path("x.yaml"))
    assert time.process_time() - start < 5
    assert cause in error.value.cause and cure in error.value.cure
    assert len(error.value.cause) < 250 and "\n" not in error.value.cause + error.value.cure


def test_prompts_are_read_by_the_same_rules(tmp_path):
    path = tmp_path / "prompts.yaml"
    path.write_text("a: &a {train: [x], heldout: [y]}\nb: *a\n")
    assert read_prompts(path)["b"] == {"train": ["x"], "heldout": ["y"]}
    path.write_text("a: {train: [x], heldout: [y]}\na: {train: [z], heldout: [y]}\n")
    with pytest.raises(ConfigError, match="'a' stands twice"):
        read_prompts(path)


# Flags, and values that are too much for a field ------------------------------------------------

FLAGS = [
    ("seed=*x", "seed needs a whole number, got the text '*x'"),
    ("seed=&a 3", "got the text '&a 3'"),
    ("seed=!!int 3", "got the text '!!int 3'"),
    ("seed='3'", "got the text ''3''"),
    ("seed=3 # x", "got the text '3 # x'"),
    ("seed=--- 3", "got the text '--- 3'"),
    ("seed={a: 1}", "got the text '{a: 1}'"),
    ("seed=", "seed has no value"),
    ("seed=~", "seed has no value"),
    ("seed=0x10", "YAML reads 0x10 as another number, for 'seed' (--seed)"),
    ("seed=9" + "9" * 9_999, "'seed' has a value of a kind no key takes: 999"),
    ("seed=99999999999999999999", "seed is a number of 20 digits"),
    ("collect.lanes=3000000000", "collect.lanes is 3000000000"),
    ("sac.lr=1" + "0" * 400, "sac.lr is a number of 401 digits"),
    ("sac.lr=!!float 3", "sac.lr needs a number, got the text '!!float 3'"),
    ("sac.lr=1e-" + "9" * 5000, "sac.lr needs a number, got the text '1e-999"),
    ("tasks.train=[a, [b]]", "unknown task 'a' in tasks.train"),
    ("tasks.train=[drawer-open", "tasks.train has one bracket of two: [drawer-open"),
    ("eval.k=0]", "eval.k has one bracket of two: 0]"),
    ("eval.k=0,,1", "eval.k has no value"),
    ("eval.k=[[0]]", "eval.k needs a whole number, got the text '[0]'"),
    ("name=a\nb", "name holds the control character \\n"),
    ("name=a\udcff", "name holds the control character \\udcff"),
    ("goals.table=a\0.npz", "goals.table holds the control character \\x00"),
]


@pytest.mark.parametrize(("flag", "cause"), FLAGS, ids=[flag[0][:30] for flag in FLAGS])
def test_flag_is_a_word_and_no_document(refused, flag, cause):
    name, _, text = flag.partition("=")
    got = refused("--config", "ml4.yaml", f"--{name}", text)
    assert cause in got[0] and len(got[0]) < 250


def test_numbers_that_flags_and_files_may_have():
    flags = {"train.env_steps": str(10**12), "sac.grad_clip": " 1_000 ", "seed": "+7"}
    config = load_config("ml4.yaml", flags)
    assert (config.train.env_steps, config.sac.grad_clip, config.seed) == (10**12, 1000.0, 7)


@pytest.mark.parametrize(("chunk", "set_to"), [(30_000_000, 200), (150, 100), (11, 10), (7, 5)])
def test_chunk_that_does_not_divide_is_answered_at_once(refused, chunk, set_to):
    start = time.process_time()
    cure = refused("--config", "ml4.yaml", "--collect.chunk", str(chunk))[1]
    assert cure == f"set collect.chunk: {set_to}" and time.process_time() - start < 2


def test_a_file_in_utf_16_is_a_config(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes("seed: 3\n".encode("utf-16"))
    assert resolve(*read_yaml(path)).seed == 3 != Config().seed
