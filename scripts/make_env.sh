#!/bin/sh
# Makes or completes the environment $VENV from requirements.lock; called by the Makefile.
# An environment made by hand is used as it is, if its Python fits.
set -eu

VENV=${VENV:-.venv}
NEEDED="Python >= 3.12, < 3.14"

fail() {
    printf 'error: %s\nfix: %s\n' "$1" "$2" >&2
    exit 2
}

# Whether $1 starts and is a Python that fits: a pyenv shim may exist and not start.
fits() {
    "$1" -c 'import sys; sys.exit(not (3, 12) <= sys.version_info[:2] < (3, 14))' >/dev/null 2>&1
}

find_python() {
    pyenv_root=$(pyenv root 2>/dev/null || echo "$HOME/.pyenv")
    for candidate in "${PYTHON:-}" python3.13 python3.12 python3 \
        "$pyenv_root"/versions/3.13*/bin/python "$pyenv_root"/versions/3.12*/bin/python; do
        if [ -n "$candidate" ] && fits "$candidate"; then
            echo "$candidate"
            return
        fi
    done
}

has_uv() {
    uv --version >/dev/null 2>&1
}

install() {
    if has_uv; then
        uv pip install --python "$VENV/bin/python" "$@"
        return
    fi
    "$VENV/bin/python" -m pip --version >/dev/null 2>&1 \
        || "$VENV/bin/python" -m ensurepip >/dev/null 2>&1 \
        || fail "$VENV has no pip and there is no uv" "install uv, or remove $VENV and make it anew"
    "$VENV/bin/python" -m pip install --disable-pip-version-check "$@"
}

if [ -x "$VENV/bin/python" ]; then
    fits "$VENV/bin/python" \
        || fail "$VENV is not an environment of $NEEDED" "remove it, or give another: VENV=DIR"
else
    python=$(find_python)
    if [ -n "$python" ]; then
        echo "making $VENV with $python"
        if has_uv; then
            uv venv --quiet --seed --allow-existing --python "$(command -v "$python")" "$VENV"
        else
            "$python" -m venv "$VENV" \
                || fail "$python cannot make environments" "install its venv package, or uv"
        fi
    elif has_uv; then
        echo "no $NEEDED here: asking uv for one"
        uv venv --quiet --seed --allow-existing --python 3.13 "$VENV" \
            || fail "uv could not get $NEEDED" "install one and name it: make PYTHON=/path/to/python"
    else
        fail "no $NEEDED found" \
            "install one, or uv, which brings one; elsewhere on disk: make PYTHON=/path/to/python"
    fi
fi

echo "installing requirements.lock into $VENV"
install --quiet -r requirements.lock
install --quiet --no-deps --no-build-isolation -e .
