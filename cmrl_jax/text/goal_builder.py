"""Makes a table of text vectors from `data/goal_prompts.yaml`: the work behind `train.py goals`.

The file carries no time of day, so a table built again from the same weights is equal byte for
byte. `goals.py` reads it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cmrl_jax.config.schema import TEXT_ENCODERS, ConfigError, call_envs
from cmrl_jax.config.yaml_tree import read_tree
from cmrl_jax.storage.output_files import writable
from cmrl_jax.text.encoders import Encoder, file_sha256, find_encoder
from cmrl_jax.text.goal_files import PROMPTS_FILE, table_path
from cmrl_jax.text.goals import GoalTable, read_table
from envs.npz import write_npz


def read_prompts(path: Path = PROMPTS_FILE) -> dict[str, dict[str, list[str]]]:
    """Reads the sentences: task -> {"train": [...], "heldout": [...]}.

    Raises:
        ConfigError: unreadable file, or not equally many distinct sentences for every task.
    """
    cure = f"give every task in {path} equally many train and heldout sentences, none twice"
    prompts, _ = read_tree(path)
    if not prompts:
        raise ConfigError(f"{path} names no tasks", cure)
    counts = set()
    for task, kinds in prompts.items():
        if not isinstance(kinds, dict) or set(kinds) != {"train", "heldout"}:
            raise ConfigError(f"{path}: {task!r} needs the two lists train and heldout", cure)
        for kind, sentences in kinds.items():
            if not isinstance(sentences, list) or not sentences:
                raise ConfigError(f"{path}: {task}.{kind} is not a list of sentences", cure)
            for sentence in sentences:
                if not isinstance(sentence, str) or not sentence.strip():
                    raise ConfigError(f"{path}: {task}.{kind} holds {sentence!r}, no text", cure)
        both = kinds["train"] + kinds["heldout"]
        if len(set(both)) < len(both):
            raise ConfigError(f"{path}: {task} has a sentence twice", cure)
        counts.add((len(kinds["train"]), len(kinds["heldout"])))
    if len(counts) > 1:
        raise ConfigError(f"{path}: (train, heldout) counts differ: {sorted(counts)}", cure)
    return prompts


def build(
    encoder: str,
    weights: Path | None = None,
    out: Path | None = None,
    force: bool = False,
    prompts_file: Path = PROMPTS_FILE,
) -> Path:
    """Encodes the prompts and writes the table that `cmrl_jax.text.goals.read_table` reads.

    Args:
        encoder: one of `config.TEXT_ENCODERS`.
        weights: model directory; None for the place where the encoder is published.
        out: npz to write; None for the packaged table of that encoder.
        force: replace a table of another encoder, or a file that is none.
        prompts_file: the YAML with the sentences.

    Returns:
        The file written.

    Raises:
        ConfigError: unknown encoder; model or package missing or broken; a file that may not be
            replaced or cannot be written.
    """
    if encoder not in TEXT_ENCODERS:
        raise ConfigError(f"unknown encoder {encoder!r}", f"use one of {', '.join(TEXT_ENCODERS)}")
    prompts = read_prompts(prompts_file)
    # Whether it can be; whether it may be replaced, its encoder decides (`_check_replaceable`).
    writable(out or table_path(encoder), "--out", encoder, force=True)
    found = find_encoder(encoder, weights)
    if out is None:
        if found.name != encoder:
            cause = f"{weights} is not the published {encoder}: sha256 {found.weights_sha256}"
            raise ConfigError(cause, f"give the table of {found.name} a file of its own: --out F")
        out = table_path(encoder)
    if not force:
        _check_replaceable(out, found)
    sentences = [kinds["train"] + kinds["heldout"] for kinds in prompts.values()]
    kinds = next(iter(prompts.values()))
    flat = found.encode([text for task in sentences for text in task])
    tables = {
        "vectors": flat.reshape(len(prompts), len(sentences[0]), -1),
        "prompts": np.array(sentences),
        "split": np.array(["train"] * len(kinds["train"]) + ["heldout"] * len(kinds["heldout"])),
        "tasks": np.array(list(prompts)),
        "encoder": np.array(found.name),
        "revision": np.array(found.revision),
        "weights_sha256": np.array(found.weights_sha256),
        "tokenizer_sha256": np.array(found.tokenizer_sha256),
        "prompts_sha256": np.array(file_sha256(prompts_file)),
    }
    call_envs(lambda: write_npz(out, tables))
    return out


def all_vectors(table: GoalTable) -> np.ndarray:
    """Returns the vectors of all sentences, held-out ones last, (task, paraphrase, G)."""
    return np.concatenate([table.vectors, table.heldout_vectors], axis=1)


def format_cosines(table: GoalTable) -> str:
    """What a table is, and the cosines between its tasks as text."""
    counts = f"{table.vectors.shape[1]} + {table.heldout_vectors.shape[1]} held-out sentences"
    width = max(map(len, table.tasks))
    release = f" ({table.revision})" if table.revision else ""
    lines = [
        f"{table.encoder}{release}, {len(table.tasks)} tasks of {counts}, "
        f"G = {table.vectors.shape[-1]}, sha256 {table.sha256}",
        "mean cosine between the different sentences of two tasks:",
        " ".join(["".ljust(width), *(task.rjust(width) for task in table.tasks)]),
    ]
    for task, row in zip(table.tasks, task_cosines(all_vectors(table)), strict=True):
        lines.append(" ".join([task.ljust(width), *(f"{x:.2f}".rjust(width) for x in row)]))
    return "\n".join(lines)


def task_cosines(vectors: np.ndarray) -> np.ndarray:
    """Returns (task, task): the mean cosine between sentences of two tasks.

    On the diagonal, between the different sentences of one task.

    Args:
        vectors: (task, paraphrase, G) of unit norm, at least two paraphrases.
    """
    every = vectors.astype(np.float64)
    count = every.shape[1]
    sums = np.einsum("ipg,jqg->ij", every, every)
    own = np.diag(np.einsum("ipg,ipg->i", every, every))  # each sentence with itself
    return (sums - own) / (count**2 - count * np.eye(len(every)))


def _check_replaceable(out: Path, found: Encoder) -> None:
    if not out.exists():
        return
    try:
        there = f"a table of {(table := read_table(out)).encoder}"
        if table.encoder == found.name:
            return
    except ConfigError:
        there = "no goal table"
    cause = f"{out} is {there}, and would become one of {found.name}"
    raise ConfigError(cause, "give another file with --out F, or replace it with --force")
