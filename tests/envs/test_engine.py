"""MUJOCO_GL and what draws nothing: no value of it stops that. Each in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MISSING = ("no-such-library", "osmesa")  # the second, where it is not installed


def python(*words, **environment):
    done = subprocess.run(
        [sys.executable, *words],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("gl", MISSING)
@pytest.mark.parametrize(
    "module",
    [
        "envs.physics.model",
        "envs.parity.reference",
        "cmrl_jax.nn.normalizers",
        "cmrl_jax.evaluation.metaworld",
    ],
)
def test_a_gl_library_that_is_missing_stops_no_import(gl, module):
    """Whichever comes first of MuJoCo, metaworld and mjx. Children see the value."""
    show = f"import os, {module}; print(os.environ['MUJOCO_GL'])"
    assert python("-c", show, MUJOCO_GL=gl) == gl


def test_goal_sets_are_drawn_without_gl(tmp_path):
    out = tmp_path / "again.npz"
    python("-m", "envs.goal_sets", "--out", str(out), MUJOCO_GL=MISSING[0])
    assert out.read_bytes() == (ROOT / "envs" / "data" / "goal_sets.npz").read_bytes()


def test_a_missing_library_leaves_no_trace_and_is_named_where_something_is_drawn():
    code = (
        "import os; from envs.engine import mujoco; from envs.render.frames import Renderer\n"
        "assert 'PYOPENGL_PLATFORM' not in os.environ\n"
        "model = mujoco.MjModel.from_xml_string('<mujoco/>')\n"
        "try: Renderer(model, 8, 8)\n"
        "except ValueError as error: print(error)"
    )
    cause, cure = python("-c", code, MUJOCO_GL=MISSING[0]).splitlines()
    assert "pictures need OpenGL" in cause and "libegl1 libosmesa6" in cure


def test_a_library_that_is_there_draws_as_ever(gl):
    code = (
        "import envs.sawyer, mujoco\n"
        "model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><light/>"
        '<geom size="1"/></worldbody></mujoco>\')\n'
        "data = mujoco.MjData(model)\n"
        "mujoco.mj_forward(model, data)\n"
        "with mujoco.Renderer(model, 32, 32) as renderer:\n"
        "    renderer.update_scene(data)\n"
        "    print(renderer.render().any())"
    )
    assert python("-c", code, MUJOCO_GL=gl) == "True"


def test_a_display_that_does_not_open_is_passed_over(gl):
    """For the library that draws there; a context alone is made on such a display, too."""
    code = (
        "import os; from envs.render.frames import choose_gl; choose_gl(); "
        "print(os.environ['MUJOCO_GL'])"
    )
    chosen = python("-c", code, MUJOCO_GL="", DISPLAY=":4242", WAYLAND_DISPLAY="")
    assert chosen in ("egl", "osmesa")
