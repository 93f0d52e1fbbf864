"""What is learned or counted, as trees of parameters and as one vector a network."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
from flax import struct

from cmrl_jax.nn.networks import Params
from cmrl_jax.nn.optimizers import ravel, unravel


class Acting(NamedTuple):
    """The parameters that act outside training's own episodes."""

    actor: Params
    encoder: Params | None


@struct.dataclass
class TrainState:
    """Everything that is learned or counted; a field that the configuration lacks is None.

    Packed, which it is inside the loop of gradient steps alone, it holds a vector in place of every
    network's tree: see `pack`.

    Attributes:
        critic_params, target_critic_params: leading axis 2 on every leaf, the twin critics.
        value_params, target_value_params: the V network of `sac.variant: v`.
        encoder_params: None unless `model.conditioning` is z.
        averaged: actor and encoder, averaged over gradient steps (`sac.policy_average`).
        log_alpha: log temperature of every training task, (T,).
        obs_stats, return_stats: running statistics (normalizers.py), updated by collection.
        gradient_steps: gradient steps applied, int32; exact below 2^31, where it stands still.
        skipped_updates: gradient steps dropped for a non-finite gradient, int32.
    """

    actor_params: Params
    critic_params: Params
    target_critic_params: Params | None
    value_params: Params | None
    target_value_params: Params | None
    encoder_params: Params | None
    averaged: Acting | None
    log_alpha: jax.Array
    actor_opt_state: Any
    critic_opt_state: Any
    value_opt_state: Any
    encoder_opt_state: Any
    alpha_opt_state: Any
    obs_stats: Any
    return_stats: Any
    gradient_steps: jax.Array
    skipped_updates: jax.Array

    @property
    def acting(self) -> Acting:
        """What acts in evaluation, and what a policy checkpoint holds."""
        return self.averaged or Acting(self.actor_params, self.encoder_params)


STACKED = ("critic_params", "target_critic_params")  # with a leading axis of the twin critics
PACKED = ("actor_params", "value_params", "target_value_params", "encoder_params", *STACKED)


def pack(state: TrainState) -> TrainState:
    """The state with each network of `PACKED` as one vector, as gradient steps use them.

    (parameter,); (2, parameter) for those in `STACKED`. The two averages are packed likewise.
    """
    flat = {name: ravel(getattr(state, name), stacked=name in STACKED) for name in PACKED}
    if state.averaged is not None:
        flat["averaged"] = Acting(*map(ravel, state.averaged))
    return replace(state, **flat)


def unpack(flat: TrainState, like: TrainState) -> TrainState:
    """The inverse of `pack`; of `like`, an unpacked state, only trees and shapes are read."""
    trees = {name: unravel(getattr(flat, name), getattr(like, name)) for name in PACKED}
    if flat.averaged is not None and like.averaged is not None:
        trees["averaged"] = Acting(*map(unravel, flat.averaged, like.averaged))
    return replace(flat, **trees)
