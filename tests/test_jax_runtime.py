"""What the environment says to jax: where compiled programs are kept, which switches are on."""

import contextlib
import os
import pwd
import types

import jax
import jax.numpy as jnp
import pytest
from run_helpers import assert_same_result, native, run_in_shell, smoke, smoke_words

from cmrl_jax import jax_runtime
from cmrl_jax.config.files import load_config
from cmrl_jax.config.schema import ConfigError
from cmrl_jax.jax_runtime import cache_directory, check_switches, jit_repeated
from cmrl_jax.registry import rules_of
from cmrl_jax.storage.run_dir import holds_run
from cmrl_jax.training.run import Run
from envs import goal_sets


@pytest.fixture
def no_home(monkeypatch):
    """A user id without an entry in the table of users, and no HOME."""

    def getpwuid(number):
        raise KeyError(number)

    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.delenv("CMRL_JAX_CACHE", raising=False)
    monkeypatch.setattr(pwd, "getpwuid", getpwuid)


def test_without_a_home_there_is_no_cache_and_one_warning(no_home, capfd):
    cache_directory.cache_clear()
    assert cache_directory("~/.cache/cmrl_jax") is cache_directory("~/.cache/cmrl_jax") is None
    [warning] = capfd.readouterr().err.splitlines()
    assert warning.startswith("warning: there is no home directory for ~/.cache/cmrl_jax")


def test_a_cache_that_cannot_be_written_is_none_and_one_warning(tmp_path, capfd):
    cache_directory.cache_clear()
    (tmp_path / "file").touch()
    assert cache_directory(str(tmp_path / "file" / "cache")) is None
    [warning] = capfd.readouterr().err.splitlines()
    assert warning.startswith(f"warning: {tmp_path}/file/cache cannot be written: Not a directory")
    assert cache_directory(str(tmp_path / "a" / "b")) == str(tmp_path / "a" / "b")
    assert capfd.readouterr().err == ""


def test_fresh_goals_need_no_home(no_home, monkeypatch):
    drawn = object()
    monkeypatch.setattr(goal_sets, "draw_goals", lambda task, seed: [drawn, task, seed])
    assert goal_sets.load_goal_set("fresh:3", ("drawer-open",))[0, 0] is drawn


def test_fresh_goals_need_no_cache_that_may_be_entered(monkeypatch, tmp_path):
    """A home of another user, as the superuser's is for everybody else."""
    (tmp_path / "goals").mkdir()
    tmp_path.chmod(0)
    monkeypatch.setattr(goal_sets, "draw_goals", lambda task, seed: [task, seed])
    with contextlib.ExitStack() as stack:
        stack.callback(tmp_path.chmod, 0o755)
        if os.geteuid() == 0:
            os.seteuid(65534)
            stack.callback(os.seteuid, 0)
        goals = goal_sets.load_goal_set("fresh:3", ("drawer-open",), cache=tmp_path)
    assert goals.tolist() == [["drawer-open", "3"]]


# Switches ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, value",
    [
        ("jax_enable_x64", True),
        ("jax_disable_jit", True),
        ("jax_debug_key_reuse", True),
        ("jax_numpy_rank_promotion", "raise"),
        ("jax_numpy_dtype_promotion", "strict"),
        ("jax_default_prng_impl", "rbg"),
        ("jax_threefry_partitionable", False),
        ("jax_random_seed_offset", 1),
        ("jax_transfer_guard", "disallow"),
        ("jax_transfer_guard_device_to_host", "disallow_explicit"),
    ],
)
def test_switches_that_do_not_work_are_named(name, value):
    check_switches()
    before = getattr(jax.config, name)
    try:
        jax.config.update(name, value)
        with pytest.raises(ConfigError) as refused:
            check_switches()
    finally:
        jax.config.update(name, before)
    assert refused.value.cause.startswith(f"{name.upper()} is {str(value).lower()}, ")
    assert refused.value.cure == f"unset {name.upper()}, and start again"
    check_switches()


@pytest.mark.slow
def test_a_run_that_looks_for_nan_is_the_undisturbed_one(undisturbed, tmp_path):
    """JAX_DEBUG_NANS: that iteration 0 has no losses is no fault."""
    with jax.debug_nans(True):
        assert smoke(tmp_path / "run", *native()) == 0
    assert_same_result(tmp_path / "run", undisturbed)


@pytest.mark.parametrize("name", ["jax_debug_nans", "jax_debug_infs"])
def test_a_run_that_looks_for_nan_stops_at_the_first(name):
    """What is otherwise skipped or put back, with a line of warning."""
    config = load_config("smoke.yaml")
    run = types.SimpleNamespace(config=config, say=lambda line: None, label="", steps=1000)
    run.rules = rules_of(config)
    run.full = types.SimpleNamespace(directory="ckpt", steps=lambda: [3])
    found = {"iteration": 3, "train/skipped": 0.0, "train/physics_faults": 0.0}
    faults = ({"train/skipped": 0.02}, {"train/physics_faults": 1.0})
    for fault in faults:
        Run.check_health(run, found | fault)  # pyright: ignore[reportArgumentType]
    with getattr(jax, name.removeprefix("jax_"))(True):
        Run.check_health(run, found)  # pyright: ignore[reportArgumentType]
        for fault in faults:
            with pytest.raises(ConfigError, match="iteration 3: .*non-finite"):
                Run.check_health(run, found | fault)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "switch, cause, cure",
    [
        ("JAX_ENABLE_X64=1", "JAX_ENABLE_X64 is true, which is not supported", "unset JAX_ENABLE"),
        ("JAX_PLATFORMS=cuda", "no device for JAX_PLATFORMS=cuda", "unset JAX_PLATFORMS"),
        ("JAX_DEBUG_NANS=maybe", "invalid truth value 'maybe' for", "correct that variable"),
    ],
)
def test_a_switch_of_jax_that_does_not_work_is_two_lines(tmp_path, switch, cause, cure):
    run = tmp_path / "run"
    name, _, value = switch.partition("=")
    done = run_in_shell("", *smoke_words(run, *native()), **{name: value})
    assert done.returncode == 2 and done.stdout == "", done
    lines = done.stderr.splitlines()
    assert len(lines) == 2 and lines[0].startswith("error: ") and cause in lines[0], done.stderr
    assert lines[1].startswith(f"fix: {cure}")
    assert not holds_run(run)  # so that the same command can be given again


# Compiler options -------------------------------------------------------------------------------


def mixed_modules(weights, modules):
    """What XLA hands to YNNPACK if it may."""
    return jnp.sum(weights[..., None] * modules[..., None, :, :], axis=-2)


def test_repeated_programs_keep_clear_of_ynnpack():
    inputs = jnp.ones((8, 1, 2, 2)), jnp.ones((8, 16, 2, 64))
    plain = jax.jit(mixed_modules).lower(*inputs).compile().as_text() or ""
    if "ynn_fusion" not in plain:  # another jaxlib or processor: there is nothing to keep clear of
        pytest.skip("this jaxlib hands YNNPACK nothing here")
    assert "ynn_fusion" not in jit_repeated(mixed_modules).lower(*inputs).compile().as_text()


def test_a_jaxlib_without_the_option_compiles_as_it_does(monkeypatch):
    known = {"xla_backend_optimization_level": 2}
    monkeypatch.setitem(jax_runtime.REPEATED, "cpu", {"xla_cpu_no_such_option": ""} | known)
    jax_runtime.repeated_options.cache_clear()
    try:
        assert jax_runtime.repeated_options() == known
    finally:
        jax_runtime.repeated_options.cache_clear()


def test_what_xla_flags_names_is_left_to_it(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_autotune_level=4")
    jax_runtime.repeated_options.cache_clear()
    try:
        options = jax_runtime.repeated_options("gpu")
    finally:
        jax_runtime.repeated_options.cache_clear()
    assert options == {"xla_gpu_enable_triton_gemm": False}
