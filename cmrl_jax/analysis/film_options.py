"""What is filmed; read before jax is imported."""

from __future__ import annotations

from dataclasses import dataclass

from cmrl_jax.evaluation.options import Adapt


@dataclass(frozen=True)
class FilmOptions:
    """What `render` was asked for.

    Attributes:
        k: exploration episodes.
        goal: index into the goal set.
        adapt: see `EvalOptions`.
        tasks: to film; None for all that the run evaluates.
        horizon: control steps an episode; None for the run's own.
        checkpoint: iteration; None for the newest.
        every: control steps from one frame of a video to the next.
        rows: episodes on a contact sheet, at most.
    """

    k: int = 1
    goal: int = 0
    goal_set: str = "heldout"
    seed: int = 0
    adapt: Adapt = "posterior"
    tasks: tuple[str, ...] | None = None
    horizon: int | None = None
    checkpoint: int | None = None
    every: int = 4
    rows: int = 3
