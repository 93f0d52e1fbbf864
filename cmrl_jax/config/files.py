"""Reads a `Config` from YAML and dotted flags, strictly, and writes it back.

Order: defaults < YAML < flags. Nothing is guessed: an unknown key, a wrong type or one of YAML's
silent conversions (`3e-4` is text to it, `017` is 15) is a `ConfigError` that names file and line.
"""

from __future__ import annotations

import functools
import math
import typing
import unicodedata
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal

import yaml

from cmrl_jax.commands import quoted
from cmrl_jax.config.rules import validate
from cmrl_jax.config.schema import Config, ConfigError, ModelConfig, leaves
from cmrl_jax.config.yaml_tree import read_scalar, read_tree
from cmrl_jax.places import PACKAGE
from envs.command_line import brief, suggest

# What a resumed run may change: how long it trains, and what it reports. Not `eval.k`, by which
# columns of metrics.csv are named.
FREE_ON_RESUME = (
    "name",
    "train.env_steps",
    "train.minutes",
    "runtime.compile_cache",
    "eval.every",
    "eval.wall_share",
    "eval.goals",
    "eval.final_goals",
    "eval.final_k",
    "eval.goal_set",
    "eval.seed",
    "log.",
    "checkpoint.",
)


FORMER_DEFAULTS = {
    "env.obs_mode": "metaworld",
    "model.router_input": "z*obs",
    "encoder.aux": "none",
    "encoder.p_empty": 0.15,
    "encoder.p_drop_goal": 0.2,
    "kl.beta": 0.1,
    "sac.policy_average": 0.0,
    "collect.scatter": 0,
    "train.capacity": 102_400,
}
"""Defaults that are others today, of runs from before a key was added."""


@functools.cache
def field_types(cls: type) -> dict[str, Any]:
    """The types of a schema class, resolved from their annotations."""
    return typing.get_type_hints(cls)


class _Source:
    """Where each dotted key was written, for messages: ` (configs/ml4.yaml:12)` or nothing."""

    def __init__(self, name: str = "", lines: Mapping[str, int] | None = None):
        self.name = name
        self.lines = lines or {}

    def __call__(self, dotted: str) -> str:
        if not self.name:
            return ""
        line = self.lines.get(dotted)
        return f" ({self.name}:{line})" if line else f" ({self.name})"


def load_config(
    name: str | Path, overrides: Mapping[str, Any] | None = None, seed: int | None = None
) -> Config:
    """The validated config of a YAML file.

    Args:
        name: a file, or the name of one in `configs/`, with or without its ending: `ml4`.
        overrides: values by dotted key, `{"sac.batch": 64}`; text is read as the flag's would be.
        seed: the same as an override of `seed`.

    Raises:
        ConfigError: a missing file, a key or value that the schema refuses, a broken rule.
    """
    overrides = dict(overrides or {}) | ({} if seed is None else {"seed": seed})
    return resolve(*read_yaml(find_config(name)), flags=overrides)


def resolve(
    data: Mapping[str, Any], source: _Source | None = None, flags: Mapping[str, Any] | None = None
) -> Config:
    """The validated config of plain YAML data under values by dotted key, text or typed."""
    config = from_dict(data, source)
    for dotted, value in (flags or {}).items():
        config = _replace(config, dotted, value)
    validate(config)
    return config


def from_dict(data: Mapping[str, Any], source: _Source | None = None) -> Config:
    """The config of plain YAML data, defaults where it is silent; types checked, rules not."""
    return _section(Config, _as_of_its_time(data), "", source or _Source())


def _as_of_its_time(data: Mapping[str, Any]) -> Mapping[str, Any]:
    """The data; a run's own record, which names whole sections, with what its defaults were."""
    model = data.get("model")
    if not isinstance(model, dict) or not set(_names(ModelConfig)) <= model.keys():
        return data
    data = dict(data)
    for dotted, value in FORMER_DEFAULTS.items():
        section, _, key = dotted.partition(".")
        if isinstance(found := data.get(section), dict):
            data[section] = {key: value} | found
    return data


def to_dict(config: Any) -> dict[str, Any]:
    """Plain nested dict with lists for tuples, equal to what its YAML loads as."""
    out = {}
    for f in fields(config):
        value = getattr(config, f.name)
        if is_dataclass(value):
            out[f.name] = to_dict(value)
        else:
            out[f.name] = list(value) if isinstance(value, tuple) else value
    return out


def to_yaml(config: Config) -> str:
    """The resolved config as YAML that loads to the same config."""
    return yaml.safe_dump(to_dict(config), sort_keys=False, default_flow_style=None)


def changed_fields(saved: Mapping[str, Any], config: Config) -> list[tuple[str, Any, Any]]:
    """(dotted name, saved value, new value) of each field that a resumed run must not change.

    Args:
        saved: `to_dict` of the run's config, or the same read back from YAML or JSON. A field it
            lacks was added later and counts as what such a run was made with.
        config: the config to go on with.
    """
    old = recorded(saved)
    changed = []
    for dotted, f, new in leaves(config):
        before = old.pop(dotted, f.default)
        before = tuple(before) if isinstance(before, list) else before
        if before != new and not dotted.startswith(FREE_ON_RESUME):
            changed.append((dotted, before, new))
    changed += [(dotted, value, None) for dotted, value in old.items()]
    return changed


def check_resumable(saved: Mapping[str, Any], config: Config, run: Path) -> None:
    """Raises ConfigError naming the fields in which `config` differs from the run's own."""
    check_origin(saved, run)
    changed = changed_fields(saved, config)
    if changed:
        shown = "; ".join(f"{name}: {_show(old)} -> {_show(new)}" for name, old, new in changed)
        raise ConfigError(
            f"{run} was started with another configuration: {shown}",
            f"resume with {quoted('--config', run / 'config.yaml')}, or start a new run without "
            "--resume",
        )


def recorded(saved: Mapping[str, Any]) -> dict[str, Any]:
    """A run's config by dotted name. A key it lacks had its default of that time; and `canonical`
    runs once took their origin from the reset observation, which need not show where the object is.
    """
    record = FORMER_DEFAULTS | {key: x for key, x in _flat(saved) if key not in RETIRED}
    if record.get("env.obs_mode") == "canonical":
        record.setdefault("env.origin", "reset observation")
    return record


def check_origin(saved: Mapping[str, Any], run: Path) -> None:
    """Raises ConfigError if a run's policy saw another origin; `saved` as in `changed_fields`."""
    old, new = recorded(saved).get("env.origin"), Config().env.origin
    if old not in (None, new):
        raise ConfigError(
            f"{run} saw canonical observations from another origin: env.origin: {old} -> {new}",
            f"train anew with {quoted('--config', run / 'config.yaml')}; its figures can be drawn",
        )


def run_config(run: Path, acts: bool = True) -> Config:
    """The configuration that a run was made with, from its own config.yaml.

    Raises:
        ConfigError: it cannot be read; or its policy, if it `acts`, would see other observations.
    """
    data, source = read_yaml(run / "config.yaml")
    if acts:
        check_origin(data, run)
    config = resolve(data, source)
    origin = recorded(data).get("env.origin", config.env.origin)
    return replace(config, env=replace(config.env, origin=origin))


def config_dirs() -> list[Path]:
    """Where a bare `ml4.yaml` is looked for: here, configs/, the repository's, the packaged."""
    package = PACKAGE
    return [Path(), Path("configs"), package.parent / "configs", package / "configs"]


def find_config(name: str | Path) -> Path:
    """The file that `--config` names.

    Raises:
        ConfigError: listing the configs that were found instead.
    """
    for folder in config_dirs():
        for file in (folder / name, folder / f"{name}.yaml"):
            if file.is_file():
                return file
    found = sorted({p.name for d in config_dirs()[1:] if d.is_dir() for p in d.glob("*.yaml")})
    close = suggest(Path(name).name, found)
    raise ConfigError(f"config '{name}' not found", f"{close}found: {', '.join(found) or 'none'}")


def read_yaml(path: Path) -> tuple[dict[str, Any], _Source]:
    """Plain data of a YAML file and the line of each key.

    Raises:
        ConfigError: a file that cannot be read or is not YAML (`yaml_tree`).
    """
    data, lines = read_tree(path)
    return data, _Source(str(path), lines)


# Keys that older configurations name, each with the one value that was ever built.
RETIRED = {
    "env.impl": "jax",
    "model.router_shared": False,
    "encoder.z_resample": "episode",
    "collect.own_context": False,
}


def _section(cls: type, data: Any, prefix: str, source: _Source) -> Any:
    """A dataclass of the schema from plain data; None, an empty section, means its defaults."""
    if data is None:
        return cls()
    if not isinstance(data, Mapping):
        where = prefix.rstrip(".")
        cause = f"'{where}' is a section, got {_show(data)}{source(where)}"
        raise ConfigError(cause, f"write its keys below it; valid: {', '.join(_names(cls))}")
    hints = field_types(cls)
    values = {}
    for key, value in data.items():
        dotted = f"{prefix}{key}"
        if dotted in RETIRED:
            if value != RETIRED[dotted]:
                cause = f"{dotted} got {_show(value)}{source(dotted)}, which was never built"
                raise ConfigError(cause, "remove the key")
            continue
        if key not in hints:
            _unknown(str(key), dotted, cls, source(dotted))
        if is_dataclass(hints[key]):
            values[key] = _section(hints[key], value, f"{dotted}.", source)
        else:
            values[key] = _leaf(value, hints[key], dotted, source(dotted))
    return cls(**values)


def _unknown(key: str, dotted: str, cls: type, where: str, typed: str = "") -> None:
    prefix = dotted[: len(dotted) - len(key)]
    elsewhere = [name for name, _, _ in leaves(Config()) if name.rpartition(".")[2] == key]
    near = suggest(dotted, [prefix + name for name in _names(cls)])
    if not near and elsewhere:
        near = f"did you mean '{elsewhere[0]}'? "
    cure = f"{near}valid: {', '.join(_names(cls))}"
    raise ConfigError(f"unknown key '{brief(typed or dotted)}'{where}", cure)


def _names(cls: type) -> list[str]:
    return [f.name for f in fields(cls)]


def _replace(config: Config, dotted: str, value: Any) -> Config:
    """`config` with one leaf set, from the text of its flag or from a value of its type.

    Raises:
        ConfigError: no such key, or a value that it cannot have.
    """
    data: Any = to_dict(config)
    owner, cls, prefix = data, Config, ""
    *sections, key = dotted.split(".")
    for section in sections:
        if not is_dataclass(field_types(cls).get(section)):
            _unknown(section, prefix + section, cls, "", dotted)
        owner, cls, prefix = owner[section], field_types(cls)[section], f"{prefix}{section}."
    hint = field_types(cls).get(key)
    if is_dataclass(hint):
        some = ", ".join(f"{dotted}.{f.name}" for f in fields(hint)[:3])
        raise ConfigError(f"'{dotted}' is a section", f"name one of its keys: {some}, ...")
    if hint is None:
        _unknown(key, dotted, cls, "")
    is_text = isinstance(value, str)
    owner[key] = parse_flag(value, hint, dotted) if is_text else _leaf(value, hint, dotted, "")
    return from_dict(data, _Source())


def parse_flag(text: str, hint: Any, dotted: str) -> Any:
    """A flag's text as plain YAML data; `a,b` and `[a, b]` both make a list.

    It is a word, not a document: anchors, aliases, tags, quotes and comments are text.
    """
    where = f" (--{dotted})"
    if typing.get_origin(hint) is tuple:
        inner = text.strip()
        if inner.startswith("[") != inner.endswith("]"):
            cause = f"{dotted} has one bracket of two: {brief(text)}{where}"
            raise ConfigError(cause, "write a,b or [a, b]")
        inner = inner.removeprefix("[").removesuffix("]")
        items = [item.strip() for item in inner.split(",")] if inner.strip() else []
        is_text = typing.get_args(hint)[0] is str
        value: Any = items if is_text else [read_scalar(item, dotted, where) for item in items]
    elif hint is str or (typing.get_origin(hint) is Literal and text):
        value = text
    else:
        value = read_scalar(text.strip(), dotted, where)
    checked = _leaf(value, hint, dotted, where)
    return list(checked) if isinstance(checked, tuple) else checked


def _leaf(value: Any, hint: Any, dotted: str, where: str) -> Any:
    """`value` as the type of its field, or a ConfigError."""
    if typing.get_origin(hint) is Literal:
        choices = typing.get_args(hint)
        if isinstance(value, str) and value in choices:
            return value
        near = suggest(value, choices) if isinstance(value, str) else ""
        cause = f"{dotted} got {_show(value)}{where}"
        raise ConfigError(cause, f"{near}valid: {', '.join(choices)}")
    if typing.get_origin(hint) is tuple:
        return _tuple(value, typing.get_args(hint), dotted, where)
    if value is None:
        cause = f"{dotted} has no value{where}"
        raise ConfigError(cause, f"give it {_KINDS[hint]}, or remove the key for its default")
    if hint in (int, float) and type(value) is int and abs(value) >= 2**63:
        cause = f"{dotted} is a number of {len(str(abs(value)))} digits{where}"
        raise ConfigError(cause, "write a whole number below 2^63")
    if hint is float and type(value) is int:
        return float(value)
    if type(value) is not hint:
        cause = f"{dotted} needs {_KINDS[hint]}, got {_show(value)}{where}"
        raise ConfigError(cause, _number_cure(value, hint) or f"write {_KINDS[hint]}")
    if hint is float and not math.isfinite(value):
        raise ConfigError(f"{dotted} is {value}{where}", "write a finite number")
    if isinstance(value, str):
        for letter in value:
            if unicodedata.category(letter) in _NO_TEXT:
                cause = f"{dotted} holds the control character {brief(letter)}{where}"
                raise ConfigError(cause, "write plain text without it")
    return value


_NO_TEXT = ("Cc", "Cs", "Zl", "Zp")  # control, half a character, line and paragraph separators
_KINDS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text (in quotes where YAML reads it as something else)",
}


def _tuple(value: Any, args: tuple[Any, ...], dotted: str, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        cause = f"{dotted} needs a list, got {_show(value)}{where}"
        raise ConfigError(cause, f"write it in brackets: [{_bare(value)}]")
    if args[-1] is not Ellipsis and len(value) != len(args):
        cause = f"{dotted} needs {len(args)} values, got {len(value)}{where}"
        raise ConfigError(cause, f"write a list of {len(args)}")
    return tuple(_leaf(item, args[0], dotted, where) for item in value)


def _number_cure(value: Any, hint: type) -> str:
    """How to write the number that `value` was meant to be, or nothing."""
    if hint not in (int, float) or isinstance(value, bool) or not isinstance(value, str | float):
        return ""
    try:
        number = float(value)
        exponent = int(str(value).strip().lower().partition("e")[2] or 0)
    except ValueError:
        return ""
    if not math.isfinite(number) or (hint is int and abs(number) >= 2**63):
        return ""
    if hint is int:
        return f"write {int(number)}" if number == int(number) else "write a whole number"
    mantissa, e, _ = str(value).strip().lower().partition("e")
    if not e:
        return f"write {number} without quotes"
    mantissa = mantissa if "." in mantissa else f"{mantissa}.0"
    mantissa = f"{mantissa}0" if mantissa.endswith(".") else mantissa
    return f"write {mantissa}e{exponent:+d}"


def _show(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "nothing", True: "true", False: "false"}[value]
    if isinstance(value, Mapping):
        return "a section"
    if isinstance(value, str):
        return f"the text '{brief(value)}'"
    return brief(str(list(value) if isinstance(value, tuple) else value))


def _bare(value: Any) -> str:
    return brief(value) if isinstance(value, str) else _show(value)


def _flat(data: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    pairs = []
    for key, value in data.items():
        if isinstance(value, Mapping):
            pairs += _flat(value, f"{prefix}{key}.")
        else:
            pairs.append((prefix + key, value))
    return pairs
