"""Reads YAML as plain data with the line of each key, strictly and within bounds.

Anchors, aliases and merge keys mean what they mean in YAML. What it would change without a word
(`017` is 15 to it, a second key replaces the first) and what no file of ours needs (tags, several
documents, aliases that unfold to millions of values) is a `ConfigError` that names file and line.
"""

from __future__ import annotations

import codecs
from pathlib import Path
from typing import Any

import yaml

from cmrl_jax.config.schema import ConfigError
from envs.command_line import brief

MAX_BYTES = 2**18  # the largest config has 6 KB; PyYAML needs seconds for a megabyte
MAX_DEPTH = 20  # a config has 3 levels; PyYAML recurses
MAX_VALUES = 10_000  # with every alias unfolded; a config has 150
_TYPES = "tag:yaml.org,2002:"
_MERGE = _TYPES + "merge"
_RESOLVER = yaml.resolver.Resolver()


def read_tree(path: Path) -> tuple[dict[str, Any], dict[str, int]]:
    """Plain data of a YAML file, and the line on which each dotted key is written.

    Raises:
        ConfigError: a file that cannot be read, that is not YAML, or holds what YAML would change.
    """
    node = _compose(_text(path), path)
    if node is None or (node.tag == f"{_TYPES}null" and not node.value):
        return {}, {}
    if not isinstance(node, yaml.MappingNode):
        raise ConfigError(f"{path} holds no mapping", "write it as `section:` and `key: value`")
    tree = _Tree(path)
    return tree.plain(node, ""), tree.lines


def read_scalar(text: str, dotted: str, where: str, tag: str | None = None) -> Any:
    """The number, boolean, date, None or text that YAML makes of an unquoted word.

    Args:
        dotted: the key it is for.
        where: where it was written, for messages: ` (configs/ml4.yaml:12)`.
        tag: the type that a YAML file gives it; text for a quoted word.

    Raises:
        ConfigError: a number that YAML reads as another one, a type of YAML that is none of ours.
    """
    usual = _RESOLVER.resolve(yaml.ScalarNode, text, (True, False))
    tag = tag or usual
    kind = tag.removeprefix(_TYPES)
    digits = text.lstrip("+-")
    if kind == "int" and (":" in text or (digits.startswith("0") and digits != "0")):
        cause = f"YAML reads {brief(text)} as another number, for '{dotted}'{where}"
        raise ConfigError(cause, "write a plain decimal number, without a leading 0 or a colon")
    if kind == "float" and ":" in text:
        cause = f"YAML reads {brief(text)} as another number, for '{dotted}'{where}"
        raise ConfigError(cause, "write a plain decimal number, without a colon")
    if tag != usual and kind != "str" and (kind, usual) != ("float", f"{_TYPES}int"):
        raise _tagged(tag, dotted, where)  # as `!!int x`, on which PyYAML stumbles
    try:
        return yaml.constructor.SafeConstructor().construct_object(yaml.ScalarNode(tag, text))
    except (yaml.YAMLError, ValueError) as error:
        cause = f"'{dotted}' has a value of a kind no key takes: {brief(text)}{where}"
        raise ConfigError(cause, "write a number, true or false, or text in quotes") from error


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}", "check the file") from error
    if len(raw) > MAX_BYTES:
        raise ConfigError(f"{path} is over {MAX_BYTES // 1024} KiB", "give a file of settings")
    is_utf16 = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        return raw.decode("utf-16" if is_utf16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not text that YAML can read", "save it as UTF-8") from error


def _compose(text: str, path: Path) -> yaml.Node | None:
    """The file's one document as PyYAML's nodes, an alias being the node it stands for."""
    try:
        composer = _Composer(text, path)
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        cause = f"{path}:{line} holds U+{error.character:04X}, a character that YAML does not allow"
        raise ConfigError(cause, "remove it, or save the file as UTF-8") from error
    try:
        return composer.get_single_node()
    except ConfigError:
        raise
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        if error.problem == "but found another document":
            cause = f"a second document begins at {path}:{line}"
            raise ConfigError(cause, "keep one of the two: a config is one document") from error
        cause = f"{path}:{line} is not valid YAML: {brief(error.problem or error.context or '')}"
        raise ConfigError(cause, "check indentation, colons and quotes there") from error
    except (ValueError, OverflowError) as error:  # PyYAML's own: "\UFFFFFFFF", %YAML 1.999..
        cause = f"{path}:{composer.line + 1} is not valid YAML: {brief(str(error))}"
        raise ConfigError(cause, "check the numbers and escapes there") from error


class _Composer(yaml.SafeLoader):
    """PyYAML's composer, but nodes are no deeper than a config's, and none is within itself."""

    def __init__(self, text: str, path: Path):
        super().__init__(text)
        self.path = path
        self.open: list[str | None] = []  # anchors of the nodes being composed

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()
        anchor, where = event.anchor, f"{self.path}:{event.start_mark.line + 1}"
        if isinstance(event, yaml.AliasEvent):
            if anchor in self.open:
                cause = f"the alias *{anchor} stands inside what it names ({where})"
                raise ConfigError(cause, "write out what should stand there")
            return super().compose_node(parent, index)
        if len(self.open) >= MAX_DEPTH:
            raise _too_deep(where)
        self.anchors.pop(anchor, None)  # YAML lets a name be given again, PyYAML does not
        self.open.append(anchor)
        node = super().compose_node(parent, index)
        self.open.pop()
        return node


class _Tree:
    """Nodes unfolded to plain data; `lines` holds the line of each dotted key met."""

    def __init__(self, path: Path):
        self.path = path
        self.lines: dict[str, int] = {}
        self.left = MAX_VALUES

    def plain(self, node: yaml.Node, dotted: str, depth: int = 0) -> Any:
        """Plain data of a node; refuses what YAML would change or drop without a word."""
        if isinstance(node, yaml.MappingNode):
            out = {}
            for key, (line, value) in self._pairs(node, dotted, depth).items():
                child = f"{dotted}.{key}" if dotted else key
                self.lines[child] = line
                out[key] = self.plain(value, child, depth + 1)
            return out
        self._check(node, dotted, depth)
        if isinstance(node, yaml.SequenceNode):
            return [self.plain(item, dotted, depth + 1) for item in node.value]
        return read_scalar(str(node.value), dotted, f" ({self._at(node)})", node.tag)

    def _pairs(
        self, node: yaml.MappingNode, dotted: str, depth: int
    ) -> dict[str, tuple[int, yaml.Node]]:
        """Key -> (its line, its value). Own keys win over merged ones, earlier merged over later.

        `<<: *base` takes over the keys of one mapping, `<<: [*first, *second]` of several.
        """
        self._check(node, dotted, depth)
        own: dict[str, tuple[int, yaml.Node]] = {}
        for key_node, value in node.value:
            key, line = self._key(key_node, dotted), key_node.start_mark.line + 1
            if key in own:
                shown = f"{dotted}.{key}" if dotted else key
                lines = f"{self.path}:{own[key][0]} and {self.path}:{line}"
                raise ConfigError(f"key '{brief(shown)}' stands twice ({lines})", "keep one")
            own[key] = line, value
        merged: dict[str, tuple[int, yaml.Node]] = {}
        if any(key_node.tag == _MERGE for key_node, _ in node.value):
            line, value = own.pop("<<")
            bases = value.value if isinstance(value, yaml.SequenceNode) else [value]
            for base in bases:
                if not isinstance(base, yaml.MappingNode):
                    cause = f"the merge key << takes over no mapping ({self.path}:{line})"
                    raise ConfigError(cause, "give it an alias of a mapping, or a list of them")
                merged = self._pairs(base, dotted, depth + 1) | merged
        return merged | own

    def _key(self, node: yaml.Node, dotted: str) -> str:
        key = str(node.value)
        if not isinstance(node, yaml.ScalarNode) or not key.strip():
            kind = "empty" if isinstance(node, yaml.ScalarNode) else "no word"
            section = f" of '{dotted}'" if dotted else ""
            raise ConfigError(f"a key{section} is {kind} ({self._at(node)})", "write `key: value`")
        if node.tag != _MERGE:  # what a value may not be, a key may not
            read_scalar(key, f"the key {brief(key)}", f" ({self._at(node)})", node.tag)
        return key

    def _check(self, node: yaml.Node, dotted: str, depth: int) -> None:
        """Bounds what aliases unfold to, and refuses the tags of mappings and lists."""
        self.left -= 1
        if self.left < 0:
            cause = f"the aliases of {self.path} unfold to over {MAX_VALUES} values"
            raise ConfigError(cause, "write out what they stand for")
        if depth >= MAX_DEPTH:
            raise _too_deep(self._at(node))
        kinds = {yaml.MappingNode: "map", yaml.SequenceNode: "seq"}
        if type(node) in kinds and node.tag != _TYPES + kinds[type(node)]:
            raise _tagged(node.tag, dotted or "the file", f" ({self._at(node)})")

    def _at(self, node: yaml.Node) -> str:
        return f"{self.path}:{node.start_mark.line + 1}"


def _tagged(tag: str, dotted: str, where: str) -> ConfigError:
    shown = brief(tag.replace(_TYPES, "!!"))
    return ConfigError(f"the tag {shown} makes '{dotted}' a kind no key takes{where}", "remove it")


def _too_deep(where: str) -> ConfigError:
    cause = f"brackets or sections are nested over {MAX_DEPTH} deep ({where})"
    return ConfigError(cause, "a config is sections of keys: `section:` and `key: value` below it")
