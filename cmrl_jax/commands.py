"""Commands as a user would type them, to be pasted into a shell."""

from __future__ import annotations

import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

SCRIPT = "cmrl"  # what the installed package is called by
CHILD = "import sys; from cmrl_jax.cli.main import main; sys.exit(main())"
"""The program for a process of its own, `python -c CHILD WORD ...`, installed or not."""


def program() -> str:
    """How this process was started: `cmrl` or `python train.py`, by a path if PATH has another."""
    started = Path(sys.argv[0])
    if started.name == SCRIPT:  # a script on the PATH is handed its full name
        found = shutil.which(SCRIPT)
        on_path = found is not None and Path(found).resolve() == started.resolve()
        return SCRIPT if on_path else shlex.quote(str(started))
    script = str(started) if started.name == "train.py" else "train.py"
    return f"{_python()} {shlex.quote(script)}"


def _python() -> str:
    """What calls this Python: `python`, unless that is another one or none."""
    own, found = Path(sys.executable), shutil.which("python")
    if found is not None and Path(found).parent == own.parent:
        return "python"
    return shlex.quote(str(own.relative_to(Path.cwd()) if own.is_relative_to(Path.cwd()) else own))


def command(*words: object) -> str:
    """A call of this program with these words, each quoted where a shell needs it."""
    return f"{program()} {quoted(*words)}"


def quoted(*words: object) -> str:
    """Words of a command, each quoted where a shell needs it."""
    return shlex.join(str(word) for word in words)


def shown(value: Any) -> str:
    """A value as a user would type it."""
    if isinstance(value, tuple):
        return ",".join(str(item) for item in value)
    return str(value).lower() if isinstance(value, bool) else str(value)
