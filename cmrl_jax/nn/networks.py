"""CMRL's networks, as a record of pure functions; only this file and layers.py know their linen.

Every network takes features x (..., feature) and a conditioning zc that broadcasts against x's
leading dims, e.g. x (task, batch, feature) with zc (task, 1, latent), or both (lane, ...).
zc is never repeated in memory: a first layer on [x, zc] is the sum of two products.

# NOTES: Soft Modularization (Yang et al. 2020), the paper against the authors' code
(RchalYang/Soft-Module: torchrl/networks/nets.py). We follow the code.
1. A gating MLP maps the product f * h from the trunk width to the gating width before routing.
2. The trunk output passes relu before the first module layer.
3. The routing of layer l sees the routings of all earlier layers, not of layer l - 1 alone.
4. relu comes after the weighted sum of modules, not before it on every module.
5. One more routing vector mixes the modules of the last layer.
6. Softmax rows are over the source modules, so routing is a convex mixture.
7. The task embedding is one linear layer; here it reads zc in place of the one-hot task id.
8. `init: official` scales by the number of OUTPUTS, though the code calls it fan-in: it reads
   dimension 0 of an (out, in) weight (also katerakelly/oyster: rlkit/torch/pytorch_util.py).
9. LayerNorm is ours: after the first trunk and gating layers, before their relu, and on every
   u^l, the rectified mixture that the next module layer reads.
10. Output heads start at U(+-3e-3) with both schemes; He-uniform heads would start the policy
    saturated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from cmrl_jax.config.schema import Config
from cmrl_jax.jax_runtime import apart
from cmrl_jax.nn.distributions import LOG_STD_MAX, LOG_STD_MIN, Gaussian
from cmrl_jax.nn.layers import MLP, Initialisers, Linear, ModuleLayer, make_initialisers

Params = Any

GOAL_FACTOR_HIDDEN = 128
MIN_VARIANCE = 1e-7


class Routing(NamedTuple):
    """Routing probabilities of a soft-modular network.

    Attributes:
        matrices: row j holds the weights of target module j over its sources,
            (..., layer - 1, module, module).
        final: weights over the last layer's modules, (..., module).
    """

    matrices: jax.Array
    final: jax.Array


def mix(weights: jax.Array, modules: jax.Array) -> jax.Array:
    """Weighted sums over modules: (..., target, source) x (..., source, d) -> (..., target, d)."""
    if weights.shape[:-2] == modules.shape[:-2]:  # a routing of its own for each x: one product
        return weights @ modules
    return jnp.sum(weights[..., None] * modules[..., None, :, :], axis=-2)


class SoftModularNet(nn.Module):
    """Soft-modular network (docs/algorithm.md); all widths and options of `ModelConfig`."""

    layers: int
    modules: int
    module_width: int
    trunk_width: int
    gating_width: int
    out: int
    router_input: str
    trunk_input: str
    temperature: float
    norm: bool
    initialisers: Initialisers

    @nn.compact
    def __call__(self, x: jax.Array, zc: jax.Array) -> tuple[jax.Array, Routing]:
        """Maps x (..., feature) and zc (..., latent) to y (..., out) and the routing.

        With `router_input: z` the routing keeps zc's leading dims, else it has those of x.
        """
        init, n = self.initialisers, self.modules

        def linear(name: str, width: int) -> Linear:
            return Linear(width, init.kernel, init.bias, name=name)

        def normed(name: str, y: jax.Array) -> jax.Array:
            return nn.LayerNorm(name=name)(y) if self.norm else y

        def probabilities(name: str, features: jax.Array, *shape: int) -> jax.Array:
            head = Linear(math.prod(shape), init.routing_kernel, init.routing_bias, name=name)
            logits = head(nn.relu(features)) / self.temperature
            return nn.softmax(logits.reshape(*logits.shape[:-1], *shape), axis=-1)  # NOTE 6

        trunk_parts = (x, zc) if self.trunk_input == "obs_z" else (x,)
        f = nn.relu(normed("trunk_norm", linear("trunk_0", self.trunk_width)(*trunk_parts)))
        f = linear("trunk_1", self.trunk_width)(f)  # (..., trunk)
        h = linear("embedding", self.trunk_width)(zc)  # NOTE 7
        e = nn.relu(f * h) if self.router_input == "z*obs" else nn.relu(h)
        e = nn.relu(normed("gating_norm", linear("gating_0", self.gating_width)(e)))
        e = linear("gating_1", self.gating_width)(e)  # (..., gating), NOTE 1

        matrices: list[jax.Array] = []
        u = nn.relu(f)  # NOTE 2
        m = ModuleLayer(n, self.module_width, init, name="modules_0")(u, shared=True)
        for layer in range(1, self.layers):
            gate = e if layer == 1 else self.condition(f"routing_in_{layer}", matrices) * e
            matrices.append(probabilities(f"routing_{layer}", gate, n, n))
            u = apart(nn.relu(mix(matrices[-1], m)))  # NOTE 4, (..., module, width)
            u = normed(f"module_norm_{layer}", u)  # NOTE 9
            m = ModuleLayer(n, self.module_width, init, name=f"modules_{layer}")(u, shared=False)
        gate = self.condition("routing_in_final", matrices) * e
        final = probabilities("routing_final", gate, n)  # (..., module), NOTE 5
        mixed = nn.relu(mix(final[..., None, :], m)[..., 0, :])
        y = Linear(self.out, init.head_kernel, init.head_bias, name="head")(mixed)
        return y, Routing(jnp.stack(matrices, axis=-3), final)

    def condition(self, name: str, matrices: list[jax.Array]) -> jax.Array:
        """Linear image of all earlier routings, (..., gating) (NOTE 3)."""
        flat = [p.reshape(*p.shape[:-2], -1) for p in matrices]
        init = self.initialisers
        return Linear(self.gating_width, init.kernel, init.bias, name=name)(
            jnp.concatenate(flat, axis=-1)
        )


class ContextEncoder(nn.Module):
    """One Gaussian factor a transition, and one of the goal text (docs/algorithm.md).

    With `encoder.aux: recon` also the decoder that z is trained through.
    """

    hidden: tuple[int, ...]
    latent_dim: int
    norm: bool
    goal_fusion: str
    goal_width: int
    decoder_out: int  # 0: no decoder
    initialisers: Initialisers

    def setup(self) -> None:
        init = self.initialisers
        self.transition_net = MLP(self.hidden, 2 * self.latent_dim, self.norm, init)
        if self.goal_fusion != "none":
            self.goal_norm = nn.LayerNorm()
            self.goal_projection = Linear(self.goal_width, init.kernel, init.bias)
        if self.goal_fusion in ("factor", "both"):
            hidden = (GOAL_FACTOR_HIDDEN,)
            self.goal_net = MLP(hidden, 2 * self.latent_dim, self.norm, init)
        if self.decoder_out:
            self.decoder = MLP(self.hidden, self.decoder_out, self.norm, init)

    def __call__(
        self,
        features: jax.Array,
        goal: jax.Array,
        goal_mask: jax.Array,
        x: jax.Array,
        zc: jax.Array,
    ) -> None:
        """Touches every part, so that `init` makes the parameters of all."""
        self.transition_factors(features, goal, goal_mask)
        if self.goal_fusion in ("factor", "both"):
            self.goal_factor(goal)
        if self.decoder_out:
            self.reconstruct(x, zc)

    def transition_factors(
        self, features: jax.Array, goal: jax.Array | None, goal_mask: jax.Array | None
    ) -> Gaussian:
        """features (..., context, feature), goal (..., G), goal_mask (...) -> (..., context, L).

        The goal is read only where the text enters every factor (`goal_fusion: concat | both`).
        """
        if self.goal_fusion not in ("concat", "both"):
            return split_factor(self.transition_net(features)[0])
        if goal is None or goal_mask is None:
            raise ValueError(f"goal_fusion '{self.goal_fusion}' needs a goal and a goal mask")
        projected = self.goal_projection(self.goal_norm(goal)) * goal_mask[..., None]
        return split_factor(self.transition_net(features, projected[..., None, :])[0])

    def goal_factor(self, goal: jax.Array) -> Gaussian:
        """goal (..., G) -> the goal's own factor (..., L)."""
        projected = self.goal_projection(self.goal_norm(goal))
        return split_factor(self.goal_net(projected)[0])

    def reconstruct(self, x: jax.Array, zc: jax.Array) -> jax.Array:
        """[obs, action] (..., feature) and z -> n-step reward and change of obs, (..., 1 + obs)."""
        return self.decoder(x, zc)[0]


def split_factor(y: jax.Array) -> Gaussian:
    """(..., 2 latent) -> mean and variance; softplus gives the variance, as in oyster's code."""
    mean, raw = jnp.split(y, 2, axis=-1)
    return Gaussian(mean, jnp.maximum(nn.softplus(raw), MIN_VARIANCE))


@dataclass(frozen=True)
class Networks:
    """Pure init and apply functions; `zc` is the conditioning (..., conditioning_size).

    Attributes:
        conditioning_size: width of zc: latent, number of tasks, or 0.
        init_actor: key -> params.
        actor: (params, obs, zc) -> mean, clipped log_std (..., act), Routing or None.
        init_critic: key -> params of both critics, leading axis 2 on every leaf.
        critic: (params, obs, action, zc) -> (2, ...), or logits (2, ..., bins).
        init_value: key -> params.
        value: (params, obs, zc) -> (...).
        init_encoder: key -> params; None without an encoder (`conditioning` is not z).
        transition_factors: (params, features, goal, goal_mask) -> Gaussian (..., context, latent).
        goal_factor: (params, goal) -> Gaussian (..., latent); None without a goal factor.
        reconstruct: (encoder_params, obs, action, zc) -> predicted reward and change of the
            observation over `sac.n_step` steps, (..., 1 + obs); None unless `encoder.aux` is recon.
    """

    conditioning_size: int
    init_actor: Callable[[jax.Array], Params]
    actor: Callable[[Params, jax.Array, jax.Array], tuple[jax.Array, jax.Array, Routing | None]]
    init_critic: Callable[[jax.Array], Params]
    critic: Callable[[Params, jax.Array, jax.Array, jax.Array], jax.Array]
    init_value: Callable[[jax.Array], Params]
    value: Callable[[Params, jax.Array, jax.Array], jax.Array]
    init_encoder: Callable[[jax.Array], Params] | None
    transition_factors: Callable[..., Gaussian] | None
    goal_factor: Callable[[Params, jax.Array], Gaussian] | None
    reconstruct: Callable[[Params, jax.Array, jax.Array, jax.Array], jax.Array] | None


def make_torso(cfg: Config, modular: bool, out: int) -> MLP | SoftModularNet:
    """The network of `model.net`, called as net(x, zc) -> (y, Routing or None)."""
    model = cfg.model
    init = make_initialisers(model.init)
    norm = model.norm == "layer"
    if model.net == "mlp" or not modular:
        return MLP(model.mlp_hidden, out, norm, init)
    layers, modules, width = model.modules
    if layers < 2:
        raise ValueError(f"model.modules needs at least 2 module layers, got {layers}")
    return SoftModularNet(
        layers=layers,
        modules=modules,
        module_width=width,
        trunk_width=model.trunk_width,
        gating_width=model.gating_width,
        out=out,
        router_input=model.router_input,
        trunk_input=model.trunk_input,
        temperature=model.router_temperature,
        norm=norm,
        initialisers=init,
    )


def apply_torso(
    net: MLP | SoftModularNet, params: Params, x: jax.Array, zc: jax.Array
) -> tuple[jax.Array, Routing | None]:
    """net(x, zc), with the type that linen's `apply` loses."""
    result: Any = net.apply(params, x, zc)
    return result


def make_networks(
    cfg: Config, obs_size: int, action_size: int, goal_size: int, num_tasks: int
) -> Networks:
    """Builds every network of a configuration.

    Args:
        cfg: only `model` and `encoder` are read.
        obs_size, action_size, goal_size: widths of observation, action and goal vector.
        num_tasks: number of training tasks, the width of a one-hot task id.

    Raises:
        ValueError: fewer than two module layers.
    """
    model, encoder = cfg.model, cfg.encoder
    sizes = {"z": encoder.latent_dim, "task_id": num_tasks, "none": 0}
    obs, action = jnp.zeros((1, obs_size)), jnp.zeros((1, action_size))
    zc = jnp.zeros((1, sizes[model.conditioning]))
    bins = 1 if model.critic == "mse" else model.critic_bins
    actor_net = make_torso(cfg, model.modular_actor, 2 * action_size)
    critic_net = make_torso(cfg, model.modular_critic, bins)
    value_net = make_torso(cfg, model.modular_critic, 1)

    def actor(params: Params, obs: jax.Array, zc: jax.Array):
        y, routing = apply_torso(actor_net, params, obs, zc)
        mean, log_std = jnp.split(y, 2, axis=-1)
        return mean, jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX), routing

    def critic(params: Params, obs: jax.Array, action: jax.Array, zc: jax.Array) -> jax.Array:
        x = jnp.concatenate([obs, action], axis=-1)
        y = jax.vmap(lambda one: apply_torso(critic_net, one, x, zc)[0])(params)  # (2, ..., bins)
        return y[..., 0] if model.critic == "mse" else y

    def init_critic(key: jax.Array) -> Params:
        x = jnp.concatenate([obs, action], axis=-1)
        return jax.vmap(lambda k: critic_net.init(k, x, zc))(jax.random.split(key, 2))

    init_encoder = transition_factors = goal_factor = reconstruct = None
    if model.conditioning == "z":
        encoder_net = ContextEncoder(
            hidden=encoder.hidden,
            latent_dim=encoder.latent_dim,
            norm=encoder.norm == "layer",
            goal_fusion=encoder.goal_fusion,
            goal_width=encoder.goal_width,
            decoder_out=1 + obs_size if encoder.aux == "recon" else 0,
            initialisers=make_initialisers(model.init),
        )
        width = obs_size + action_size + 1 + (obs_size if encoder.use_next_obs else 0)
        x = jnp.concatenate([obs, action], axis=-1)
        goal = jnp.zeros((1, goal_size))
        example = (jnp.zeros((1, 1, width)), goal, jnp.zeros((1,)), x, zc)

        def encode(params: Params, *inputs: jax.Array | None, method: str) -> Any:
            return encoder_net.apply(params, *inputs, method=method)

        init_encoder = lambda key: encoder_net.init(key, *example)
        transition_factors = partial(encode, method="transition_factors")
        if encoder.goal_fusion in ("factor", "both"):
            goal_factor = partial(encode, method="goal_factor")
        if encoder.aux == "recon":
            reconstruct = lambda params, obs, action, zc: encode(
                params, jnp.concatenate([obs, action], axis=-1), zc, method="reconstruct"
            )

    return Networks(
        conditioning_size=sizes[model.conditioning],
        init_actor=lambda key: actor_net.init(key, obs, zc),
        actor=actor,
        init_critic=init_critic,
        critic=critic,
        init_value=lambda key: value_net.init(key, obs, zc),
        value=lambda params, obs, zc: apply_torso(value_net, params, obs, zc)[0][..., 0],
        init_encoder=init_encoder,
        transition_factors=transition_factors,
        goal_factor=goal_factor,
        reconstruct=reconstruct,
    )
