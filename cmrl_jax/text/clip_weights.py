"""Where CLIP's weights come from: a directory, or the hub at one pinned revision.

A directory holds config.json and model.safetensors, or config.json and flax_model.msgpack.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cmrl_jax.config.schema import ConfigError
from cmrl_jax.storage.documents import read_json
from cmrl_jax.text.clip_text import CURE

REPOSITORY = "openai/clip-vit-base-patch32"
# A commit that adds model.safetensors, the tensors of the published pytorch_model.bin, to the
# repository, whose main branch holds no safetensors.
REVISION = "b33cedfd0df4e43b8238760678fcc89e1a0d38b3"
SHA256 = "99d28a652e6ec46629ab7047a0ac82c69b1fe11e0ce672c43af65d3a9a3fc05d"
SAFETENSORS, MSGPACK = "model.safetensors", "flax_model.msgpack"


def download() -> Path:
    """Returns a directory with the published files, from the hub or from its local cache.

    Raises:
        ConfigError: they are not in the cache and the hub cannot be reached.
    """
    import huggingface_hub
    from huggingface_hub.utils import logging

    print(f"{REPOSITORY} at {REVISION[:7]}, from the hub or its cache ...", flush=True)
    level = logging.get_verbosity()
    logging.set_verbosity_error()  # else each of its retries is a line before our two
    try:
        for name in ("config.json", SAFETENSORS):
            file = huggingface_hub.hf_hub_download(REPOSITORY, name, revision=REVISION)
    except Exception as error:  # the hub client's classes, those of its transports, OSError
        reason = (str(error) or type(error).__name__).partition(". ")[0]
        raise ConfigError(
            f"{REPOSITORY} cannot be downloaded: {reason}",
            f"where the hub can be reached fetch config.json and {SAFETENSORS} of revision "
            f"{REVISION}, and give their directory with --weights DIR",
        ) from error
    finally:
        logging.set_verbosity(level)
    return Path(file).parent


def find_model(directory: Path) -> Path:
    """Returns the file with the weights, safetensors before msgpack.

    Raises:
        ConfigError: no config.json, or no weights that can be read without torch.
    """
    for name in (SAFETENSORS, MSGPACK):
        if (directory / name).is_file():
            if not (directory / "config.json").is_file():
                raise ConfigError(f"{directory} has no config.json", CURE)
            return directory / name
    if (directory / "pytorch_model.bin").is_file():
        raise ConfigError(
            f"{directory} has pytorch_model.bin alone, which only torch can read",
            f"where torch is, save it with safetensors as {SAFETENSORS}, or fetch that file: "
            f"{REPOSITORY} has it at revision {REVISION}",
        )
    raise ConfigError(f"{directory} has no {SAFETENSORS} and no {MSGPACK}", CURE)


def read_config(directory: Path) -> Mapping[str, Any]:
    """Reads config.json.

    Raises:
        ConfigError: it is no JSON object.
    """
    return read_json(directory / "config.json", CURE)


def read_tensors(model: Path) -> dict[str, np.ndarray]:
    """Reads the text tower's tensors, under the names of `clip_text.to_params`.

    Raises:
        ConfigError: the file is truncated or of another kind.
    """
    read = _read_safetensors if model.suffix == ".safetensors" else _read_msgpack
    try:
        return read(model)
    except Exception as error:  # safetensors, msgpack and flax each have their own classes
        reason = f"{type(error).__name__}: {error}".splitlines()[0][:200]
        cause = f"{model} is truncated or of another format: {reason}"
        raise ConfigError(cause, CURE) from error


def _is_text(name: str) -> bool:
    return name.startswith(("text_model.", "text_projection."))


def _read_safetensors(model: Path) -> dict[str, np.ndarray]:
    from safetensors import safe_open

    with safe_open(model, framework="numpy") as file:  # the image tower is not read at all
        return {name: file.get_tensor(name) for name in file.keys() if _is_text(name)}


def _read_msgpack(model: Path) -> dict[str, np.ndarray]:
    from flax.serialization import msgpack_restore
    from flax.traverse_util import flatten_dict

    flat = flatten_dict(msgpack_restore(model.read_bytes()), sep=".")
    return {name: np.asarray(values) for name, values in flat.items() if _is_text(name)}
