"""Entry point: `python train.py --config ml4.yaml`.

Written in the syntax of old Pythons, so that one of them prints a cure and not a SyntaxError.
"""

import sys

CURE = "fix: run `make train`, which finds or makes the right environment\n"


def start():
    """Runs the command line; a Python or package that is not there is one cause and one cure."""
    if sys.version_info < (3, 12):
        sys.stderr.write("error: Python >= 3.12 is needed, this is %d.%d\n" % sys.version_info[:2])
        sys.stderr.write(CURE)
        return 2
    import importlib.util

    try:
        from cmrl_jax.cli.main import main

        return main()
    except ModuleNotFoundError as error:
        missing = (error.name or "cmrl_jax").partition(".")[0]
        ours = missing in ("cmrl_jax", "envs") or missing in sys.stdlib_module_names
        if ours or importlib.util.find_spec(missing) is not None:
            raise
        sys.stderr.write("error: the package '%s' is not installed for this Python\n" % missing)
        sys.stderr.write(CURE)
        return 2


if __name__ == "__main__":
    sys.exit(start())
