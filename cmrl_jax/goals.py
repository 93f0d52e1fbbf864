"""Text goals as constants: a packaged table of sentence vectors, and two ablations of it.

The training loop only ever sees the arrays. `build_goals.py` makes the table; nothing here needs
an encoder.
"""

from __future__ import annotations

import difflib
import hashlib
import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cmrl_jax.config import TASKS, ConfigError

_DATA = Path(__file__).parent / "data"
PROMPTS_FILE = _DATA / "goal_prompts.yaml"
DEFAULT_TABLE = "minilm-l6-v2"
ABLATIONS = ("one-hot", "zero")


@dataclass(frozen=True)
class GoalTable:
    """The goals of some tasks as vectors of width G.

    Attributes:
        tasks: task names, in the order of the arrays' first axis.
        vectors: float32 (task, paraphrase, G), what training draws from. Evaluation uses
            paraphrase 0.
        heldout_vectors: float32 (task, held-out paraphrase, G), never trained on.
        prompts, heldout_prompts: the sentences behind the rows, [task][paraphrase].
        encoder: the encoder's name, or that of the ablation.
        revision: which release of the encoder.
        sha256: of the table file's content; for an ablation, of its vectors.
    """

    tasks: tuple[str, ...]
    vectors: np.ndarray
    heldout_vectors: np.ndarray
    prompts: tuple[tuple[str, ...], ...]
    heldout_prompts: tuple[tuple[str, ...], ...]
    encoder: str
    revision: str
    sha256: str

    def select(self, tasks: Sequence[str]) -> GoalTable:
        """Returns the rows of `tasks`, in that order.

        Raises:
            ConfigError: a task the table has no sentences for.
        """
        for task in tasks:
            if task not in self.tasks:
                raise ConfigError(
                    f"the goal table {self.encoder} has no task {task!r}{_meant(task, self.tasks)}",
                    f"use its tasks: {', '.join(self.tasks)}",
                )
        rows = [self.tasks.index(task) for task in tasks]
        return replace(
            self,
            tasks=tuple(tasks),
            vectors=self.vectors[rows],
            heldout_vectors=self.heldout_vectors[rows],
            prompts=tuple(self.prompts[row] for row in rows),
            heldout_prompts=tuple(self.heldout_prompts[row] for row in rows),
        )


def table_path(name: str) -> Path:
    """Returns where the packaged table of encoder `name` lies, whether or not it exists."""
    return _DATA / f"goals-{name}.npz"


def load_goals(table: str, tasks: tuple[str, ...]) -> GoalTable:
    """Returns the goal vectors of `tasks`.

    Args:
        table: an encoder whose table is packaged, or an ablation: `one-hot` says which task it is
            and nothing else (G = 4, the same row for a task whatever the others are); `zero` is the
            default table with every vector 0, so shapes and sentences stay.
        tasks: task names, the order of the arrays' first axis.

    Raises:
        ConfigError: unknown table or task; missing or corrupt file.
    """
    if table == "one-hot":
        eye = np.eye(len(TASKS), dtype=np.float32)[:, None, :]  # (task, 1, G)
        names = tuple((task,) for task in TASKS)
        return _ablation(
            GoalTable(TASKS, eye, eye, names, names, encoder=table, revision="", sha256="")
        ).select(tasks)
    if table == "zero":
        text = read_table(table_path(DEFAULT_TABLE))
        return _ablation(
            replace(
                text,
                vectors=np.zeros_like(text.vectors),
                heldout_vectors=np.zeros_like(text.heldout_vectors),
                encoder=table,
                revision="",
            )
        ).select(tasks)
    packaged = sorted(path.stem.removeprefix("goals-") for path in _DATA.glob("goals-*.npz"))
    if table not in packaged:
        valid = (*packaged, *ABLATIONS)
        raise ConfigError(
            f"there is no goal table {table!r}{_meant(table, valid)}",
            f"use one of {', '.join(valid)}, or build one: "
            f"python -m cmrl_jax.build_goals --encoder {table}",
        )
    return read_table(table_path(table)).select(tasks)


def read_table(path: Path) -> GoalTable:
    """Reads a table that `build_goals` wrote, with all its tasks.

    Raises:
        ConfigError: missing, corrupt or inconsistent file.
    """
    cure = "restore the file (git checkout) or build it: python -m cmrl_jax.build_goals --help"
    try:
        content = path.read_bytes()
        with np.load(io.BytesIO(content), allow_pickle=False) as data:
            arrays = {key: data[key] for key in data.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ConfigError(f"the goal table {path} cannot be read: {error}", cure) from None
    try:
        vectors, prompts = arrays["vectors"], arrays["prompts"]
        tasks = tuple(arrays["tasks"].tolist())
        heldout = arrays["split"] == "heldout"
        encoder, revision = str(arrays["encoder"]), str(arrays["revision"])
    except KeyError as error:
        raise ConfigError(f"the goal table {path} lacks {error}", cure) from None
    if (
        vectors.ndim != 3
        or vectors.dtype != np.float32
        or prompts.shape != vectors.shape[:2]
        or heldout.shape != vectors.shape[1:2]
        or len(tasks) != len(vectors)
        or heldout.all()
        or not np.allclose(np.linalg.norm(vectors, axis=-1), 1, atol=1e-4)
    ):
        raise ConfigError(
            f"the goal table {path} is inconsistent: {vectors.dtype} vectors {vectors.shape}, "
            f"prompts {prompts.shape}, {len(tasks)} tasks, or vectors that are not of unit norm",
            cure,
        )
    return GoalTable(
        tasks=tasks,
        vectors=vectors[:, ~heldout],
        heldout_vectors=vectors[:, heldout],
        prompts=_rows(prompts[:, ~heldout]),
        heldout_prompts=_rows(prompts[:, heldout]),
        encoder=encoder,
        revision=revision,
        sha256=hashlib.sha256(content).hexdigest(),
    )


def _ablation(table: GoalTable) -> GoalTable:
    content = table.encoder.encode() + table.vectors.tobytes()
    return replace(table, sha256=hashlib.sha256(content).hexdigest())


def _rows(prompts: np.ndarray) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(row) for row in prompts.tolist())


def _meant(got: str, valid: Sequence[str]) -> str:
    close = difflib.get_close_matches(got, valid, n=1)
    return f"; did you mean {close[0]!r}?" if close else ""
