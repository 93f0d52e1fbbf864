"""Entry point: `python train.py --config ml4.yaml`.

Written in the syntax of old Pythons, so that one of them prints a cure and not a SyntaxError.
"""

import os
import shlex
import sys

OWN = os.path.join(os.path.dirname(os.path.abspath(__file__)), ".venv", "bin", "python")


def refuse(cause):
    """A line of cause and one of cure: the environment of `make train`, if it is there."""
    cure = "run `make train`, which finds or makes the right environment"
    if os.path.exists(OWN) and not sys.executable.startswith(os.path.dirname(OWN)):
        cure = "%s %s" % (os.path.relpath(OWN), " ".join(map(shlex.quote, sys.argv)))
    sys.stderr.write("error: %s\nfix: %s\n" % (cause, cure))
    return 2


def start():
    """Runs the command line, unless this Python is too old or a package is not there."""
    if sys.version_info < (3, 12):
        return refuse("Python >= 3.12 is needed, this is %d.%d" % sys.version_info[:2])
    import importlib.util

    try:
        from cmrl_jax.cli.main import main

        return main()
    except ModuleNotFoundError as error:
        missing = (error.name or "cmrl_jax").partition(".")[0]
        ours = missing in ("cmrl_jax", "envs") or missing in sys.stdlib_module_names
        if ours or importlib.util.find_spec(missing) is not None:
            raise
        return refuse("the package '%s' is not installed for this Python" % missing)


if __name__ == "__main__":
    sys.exit(start())
