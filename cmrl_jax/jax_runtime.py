"""What this process asks of jax before any work: switches it can work with, a device, a cache.

jax reads dozens of switches from the environment (JAX_DEBUG_NANS). Those that this program cannot
run under, or under which a seed would name other numbers, are refused here by name; all others
work, or are the user's own business.
"""

from __future__ import annotations

import functools
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.streams import to_stderr

ALLOWED = (None, "allow", "log", "log_explicit")
GUARDS = ("", "_host_to_device", "_device_to_host", "_device_to_device")
SEED = "a seed would name other numbers"
# Switch -> the values that work, and why others do not.
SWITCHES: dict[str, tuple[tuple[Any, ...], str]] = {
    "jax_enable_x64": ((False,), "states and checkpoints are float32"),
    "jax_disable_jit": ((False,), "op by op it takes minutes to get to the first iteration"),
    "jax_debug_key_reuse": ((False,), "an evaluation splits its key twice, once for each half"),
    "jax_numpy_rank_promotion": (("allow", "warn"), "a network's bias is broadcast over lanes"),
    "jax_numpy_dtype_promotion": (("standard",), "masks of whole numbers weigh float32"),
    "jax_default_prng_impl": (("threefry2x32",), SEED),
    "jax_threefry_partitionable": ((True,), SEED),
    "jax_random_seed_offset": ((0,), SEED),
} | {
    f"jax_transfer_guard{way}": (ALLOWED, "the host reads figures and writes goals all the time")
    for way in GUARDS
}


def check_switches() -> None:
    """Raises ConfigError naming the first switch of jax that is set to what does not work here."""
    for name, (works, reason) in SWITCHES.items():
        value = getattr(jax.config, name)
        if value not in works:
            shown = str(value).lower() if isinstance(value, bool) else value
            cause = f"{name.upper()} is {shown}, which is not supported: {reason}"
            raise ConfigError(cause, f"unset {name.upper()}, and start again")


def first_device() -> Any:
    """The `jax.Device` that programs run on.

    Raises:
        ConfigError: there is none of the kind that JAX_PLATFORMS asks for.
    """
    try:
        return jax.devices()[0]
    # What jax raises depends on whether it knows the platform, and on what its plugin says.
    except (RuntimeError, AssertionError) as error:
        platforms = jax.config.jax_platforms  # pyright: ignore[reportAttributeAccessIssue]
        lines = str(error).splitlines() or ["it has no such backend"]
        cause = f"jax finds no device for JAX_PLATFORMS={platforms}: {lines[0][:200]}"
        cure = "unset JAX_PLATFORMS to take the device that is there, or install jax for that one"
        raise ConfigError(cause, cure) from error


# Compiler options of programs that run often, by platform.
REPEATED = {
    # XLA's CPU backend may hand sums and products to YNNPACK, fused with what stands around them.
    # With that the main job makes 28 gradient steps a second on one core instead of 52, and 41
    # instead of 63 on two (jaxlib 0.12.0, AVX2).
    "cpu": {"xla_cpu_experimental_ynn_fusion_type": ""},
    # For a GPU XLA may write a kernel of its own for each product, by Triton, and try dozens of
    # them and of cuBLAS's. Ours are small. With cuBLAS a gradient step of ml4.yaml starts 28
    # kernels less; untried, a training iteration compiles in half the time.
    "gpu": {"xla_gpu_enable_triton_gemm": False, "xla_gpu_autotune_level": 0},
}


@functools.cache
def repeated_options(platform: str | None = None) -> dict[str, Any]:
    """Options of `REPEATED`, but for what XLA_FLAGS names and what this jaxlib lacks.

    Args:
        platform: as jax names it, to be taken at its word; by default that of this process.
    """
    named = os.environ.get("XLA_FLAGS", "")
    options = REPEATED.get(platform or jax.default_backend(), {})
    options = {name: value for name, value in options.items() if name not in named}
    if platform is not None:
        return options
    return {name: value for name, value in options.items() if is_option(name, value)}


def is_option(name: str, value: Any) -> bool:
    """Whether this jaxlib has a compiler option."""
    try:
        jax.jit(lambda: 0, compiler_options={name: value})()
    except RuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return False
    return True


def jit_repeated(function: Callable[..., Any], **options: Any) -> Any:
    """`jax.jit` for a program that runs often, as training's iteration does.

    Args:
        options: of `jax.jit`.
    """
    return jax.jit(function, compiler_options=repeated_options(), **options)


def jit_once(function: Callable[..., Any], **options: Any) -> Any:
    """`jax.jit` for a program that runs once: compiled with little optimisation, in a third of the
    time for initial states (12.2 against 3.6 s; the numbers are the same).

    Args:
        options: of `jax.jit`.
    """
    return jax.jit(function, compiler_options={"xla_backend_optimization_level": 1}, **options)


def apart(tree: Any) -> Any:
    """The same arrays, which XLA is not to compute once more inside of what reads them.

    On a GPU one kernel may so hold a normalisation or a softmax with all that leads to it, and
    need more registers than there are: ml4-large.yaml had four such, of a gradient step that
    compiled in 232 s with them and in 21 s without (kernels tried). A CPU is as fast either way.
    """
    return jax.lax.optimization_barrier(tree)


def free_bytes() -> int | None:
    """Memory that each device can still give; None where nobody says."""
    stats = jax.local_devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"] - stats.get("bytes_in_use", 0)
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = next(1024 * int(line.split()[1]) for line in lines if "MemAvailable" in line)
        return free // len(jax.local_devices())
    except (OSError, StopIteration):
        return None


@functools.cache  # so that a process that asks again is not told again
def cache_directory(text: str) -> str | None:
    """A directory for compiled programs, made if need be; None, with a warning, where none can be.

    Args:
        text: `runtime.compile_cache`.
    """
    try:
        path = Path(text).expanduser()
        path.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path).close()
    except RuntimeError:
        reason = f"there is no home directory for {text}"
    except OSError as error:
        reason = f"{path} cannot be written: {error.strerror}"
    else:
        return str(path)
    to_stderr(f"warning: {reason}; programs are compiled at each start (runtime.compile_cache)")
    return None
