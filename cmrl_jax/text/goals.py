"""Text goals as constants: a table of sentence vectors, and three ablations of the packaged one.

The training loop only ever sees the arrays. `goal_builder.py` makes the table; nothing here needs
an encoder.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cmrl_jax.commands import command
from cmrl_jax.config.schema import GOAL_ABLATIONS, ConfigError, call_envs
from cmrl_jax.registry import other_task, tasks_beside
from cmrl_jax.text.goal_files import find_table
from envs.command_line import suggest
from envs.tasks import METAWORLD_TASKS

ONE_HOT_WIDTH = 4  # at least: policies trained before a task was added keep their width


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
                    f"the goal table {self.encoder} has no task '{task}'",
                    f"{suggest(task, self.tasks)}its tasks: {', '.join(self.tasks)}; for others "
                    "build a table (python train.py goals), or set goals.table: one-hot",
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


def load_goals(table: str, tasks: tuple[str, ...] | None = None) -> GoalTable:
    """Returns the goal vectors of `tasks`.

    Args:
        table: an encoder whose table is packaged or was built, the path of an .npz, or an ablation:
            `one-hot` says which task it is and nothing else, the same row for a task whatever the
            others are; `zero` is the default table with every vector 0, so shapes
            and sentences stay; `shuffled` is the default table with another task's sentences for
            each task.
        tasks: task names, the order of the arrays' first axis; None for all that the table has.

    Raises:
        ConfigError: unknown table or task; missing or corrupt file.
    """
    if table == "one-hot":
        return _one_hot(tasks)
    text = read_table(find_table(table))
    if table == "zero":
        text = replace(
            text,
            vectors=np.zeros_like(text.vectors),
            heldout_vectors=np.zeros_like(text.heldout_vectors),
        )
    elif table == "shuffled":
        # Each task takes another's: open-drawer words for window-close. No task keeps its own, and
        # unlike a swap of verbs or of objects it breaks what two tasks on one object share.
        others = call_envs(lambda: [other_task(task) for task in text.tasks])
        text = replace(text.select(others), tasks=text.tasks)
    if table in GOAL_ABLATIONS:
        text = _ablation(replace(text, encoder=table, revision=""))
    return text.select(tasks or text.tasks)


def _one_hot(tasks: tuple[str, ...] | None) -> GoalTable:
    beside = call_envs(lambda: tasks_beside(tasks[0] if tasks else METAWORLD_TASKS[0]))
    named: tuple[str, ...] = tasks or beside[:ONE_HOT_WIDTH]
    width = max(ONE_HOT_WIDTH, *(1 + beside.index(task) for task in named if task in beside))
    known = beside[:width]
    eye = np.eye(len(known), width, dtype=np.float32)[:, None, :]  # (task, 1, G)
    names = tuple((task,) for task in known)
    table = GoalTable(known, eye, eye, names, names, encoder="one-hot", revision="", sha256="")
    return _ablation(table).select(named)


def check_same_table(table: GoalTable, recorded_sha256: str, run: Path, cure: str = "") -> None:
    """Raises ConfigError unless `table` is the one that a run was trained with.

    Args:
        recorded_sha256: `goals_sha256` of the run's checkpoints.
        cure: what to do about it, where putting the table back is not all.
    """
    if table.sha256 != recorded_sha256:
        raise ConfigError(
            f"{run} was trained with another goal table ({recorded_sha256[:12]}) than "
            f"{table.encoder} is now ({table.sha256[:12]})",
            cure or "put that table back, or start a new run",
        )


def read_table(path: Path) -> GoalTable:
    """Reads a table that `goal_builder` wrote, with all its tasks.

    Raises:
        ConfigError: missing, corrupt or inconsistent file.
    """
    cure = f"restore the file, or build it: {command('goals', '--help')}"
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
