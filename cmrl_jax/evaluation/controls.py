"""Controls of an evaluation: what an episode is acted on in place of the lane's own memory.

They answer "is z used, is the text?": a policy whose score survives another lane's z does not use
z. None depends on the order in which tasks are evaluated; whose sentence a lane is given is the
registry's matter (`registry.other_task`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, assert_never

import jax
import numpy as np

from cmrl_jax.algorithms.base import Told
from cmrl_jax.evaluation.episode import Lanes
from cmrl_jax.evaluation.options import ZSource

_SHUFFLE_SEED = 0  # one derangement for everybody, so that runs are compared lane by lane


def sources(
    z: ZSource, lanes: Lanes, told: Told, blank: Callable[[Told], Any]
) -> Callable[[Any, np.ndarray], Any]:
    """What lanes act on: (memories of all lanes (policy, lane, ...), chosen lanes) -> theirs.

    Args:
        z: `posterior` the own memory; `text` one without experience; `prior` one without text,
            either; `shuffled` and `other` another lane's, see `donors`.
        told: what the lanes are told (policy, lane, ...).
        blank: the memories of lanes that have seen nothing.
    """
    match z:
        case "posterior":
            return take_lanes
        case "text" | "prior":
            blanks = without_experience(z, told, blank)
            return lambda _, index: take_lanes(blanks, index)
        case "shuffled" | "other":
            donor = donors(z, lanes.lane_id, lanes.env_task)
            return lambda memories, index: take_lanes(memories, donor[index])
        case _:
            assert_never(z)


def without_experience(
    z: Literal["text", "prior"], told: Told, blank: Callable[[Told], Any]
) -> Any:
    """Memories of lanes that have seen nothing; with `prior` they are told nothing, either."""
    mask = np.zeros_like(told.text_mask) if z == "prior" else told.text_mask
    return blank(told._replace(text_mask=mask))


def take_lanes(memories: Any, index: np.ndarray) -> Any:
    """Memories (policy, lane, ...) of some lanes."""
    return jax.tree.map(lambda x: x[:, index], memories)


def donors(
    z: Literal["shuffled", "other"], lane_id: np.ndarray, env_task: np.ndarray
) -> np.ndarray:
    """The lane whose memory each lane acts on, (lane,) indices.

    Args:
        z: `shuffled` takes another lane of the whole evaluation, tasks mixed; `other` the same
            goal and draw of the next task.
        lane_id: (lane,), each once.
        env_task: (lane,).
    """
    own = np.arange(len(lane_id))
    if z == "shuffled":
        # A cycle through all lanes in random order: nobody is left with their own.
        cycle = np.argsort(lane_id)[np.random.default_rng(_SHUFFLE_SEED).permutation(len(own))]
        own[cycle] = np.roll(cycle, -1)
    else:
        by_lane = np.lexsort((lane_id, env_task)).reshape(len(np.unique(env_task)), -1)
        own[by_lane] = np.roll(by_lane, -1, axis=0)
    return own


def text_per_goal(vectors: Sequence[np.ndarray], goals: int) -> np.ndarray:
    """Text vectors of each task's goals (task, goal, G): goal g takes sentence g mod n.

    Args:
        vectors: of each task, its sentences (n, G).
    """
    return np.stack([rows[np.arange(goals) % len(rows)] for rows in vectors]).astype(np.float32)
