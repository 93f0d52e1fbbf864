"""How goal sets are called: `train`, `heldout`, `fresh:<seed>`; one name for each set.

Light: what a configuration and a command line check before numpy is imported. `goal_sets.py` has
the goals themselves.
"""

from __future__ import annotations

from envs.command_line import LARGEST, brief, suggest

GOALS = 50
"""Goals of one task in a set: what Meta-World's task maker draws."""
SEEDS = {"train": 0, "heldout": 1000}
"""Seed of each packaged set."""
LARGEST_SEED = LARGEST
"""Of every seed, whatever it is for: numbers that are 2**32 apart would be one key of jax."""


def seed_of(name: str) -> int:
    """The seed that a goal set is drawn with.

    Raises:
        ValueError: no set has this name, or it is not the one name of its set, by which figures of
            an evaluation are told apart (two lines: cause, cure).
    """
    if name in SEEDS:
        return SEEDS[name]
    kind, _, digits = name.partition(":")
    if kind != "fresh" or not (digits.isascii() and digits.isdigit()):
        meant = suggest(name, SEEDS)
        valid = f"valid: {', '.join(SEEDS)}, fresh:<seed>, as fresh:7"
        raise ValueError(f"'{brief(name)}' is no goal set\n{meant}{valid}")
    if len(digits.lstrip("0")) > len(str(LARGEST_SEED)) or int(digits) > LARGEST_SEED:
        cause = f"'{brief(name)}' has a seed that is too large for a goal set"
        raise ValueError(f"{cause}\nuse one up to {LARGEST_SEED}")
    only = name_of(int(digits))
    if name != only:
        raise ValueError(f"'{brief(name)}' is the goal set '{only}'\ncall it {only}")
    return int(digits)


def name_of(seed: int) -> str:
    """The name of the goal set that is drawn with a seed."""
    packaged = {number: name for name, number in SEEDS.items()}
    return packaged.get(seed, f"fresh:{seed}")
