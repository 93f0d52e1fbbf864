"""Soft-modular forward against plain numpy loops, initial ranges, conditioning, twin critics."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmrl_jax.config.schema import Config, EncoderConfig, ModelConfig
from cmrl_jax.jax_runtime import jit_once
from cmrl_jax.nn.layers import make_initialisers
from cmrl_jax.nn.networks import SoftModularNet, make_networks

TASKS, BATCH, FEATURES, LATENT = 2, 3, 5, 4
TRUNK, GATING, WIDTH, OUT = 6, 5, 4, 2


def make_net(layers, modules, router_input="z*obs", trunk_input="obs", norm=False, temperature=1.0):
    return SoftModularNet(
        layers=layers,
        modules=modules,
        module_width=WIDTH,
        trunk_width=TRUNK,
        gating_width=GATING,
        out=OUT,
        router_input=router_input,
        trunk_input=trunk_input,
        temperature=temperature,
        norm=norm,
        initialisers=make_initialisers("official"),
    )


def spread(params, seed=0):
    """Replaces the small initial values by large ones, so that every path shows."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(
        lambda x: jnp.asarray(rng.normal(scale=0.7, size=x.shape), jnp.float32), params
    )


def forward_by_loops(p, x, z, layers, n, router_input, trunk_input, norm, temperature):
    """One sample of docs/algorithm.md's soft modules in float64, module by module."""
    p = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), p)

    def linear(name, y):
        return y @ p[name]["kernel"] + p[name]["bias"]

    def layer_norm(name, y):
        if not norm:
            return y
        centred = (y - y.mean()) / np.sqrt(y.var() + 1e-6)
        return centred * p[name]["scale"] + p[name]["bias"]

    def relu(y):
        return np.maximum(y, 0.0)

    def softmax(y):
        y = np.exp((y - y.max()) / temperature)
        return y / y.sum()

    trunk_in = np.concatenate([x, z]) if trunk_input == "obs_z" else x
    f = linear("trunk_1", relu(layer_norm("trunk_norm", linear("trunk_0", trunk_in))))
    h = linear("embedding", z)
    e = relu(f * h) if router_input == "z*obs" else relu(h)
    e = linear("gating_1", relu(layer_norm("gating_norm", linear("gating_0", e))))

    def module(layer, j, y):
        return y @ p[f"modules_{layer}"]["kernel"][j] + p[f"modules_{layer}"]["bias"][j]

    outputs = [module(0, j, relu(f)) for j in range(n)]
    routings = []
    for layer in range(1, layers):
        if layer == 1:
            gate = e
        else:
            gate = linear(f"routing_in_{layer}", np.concatenate([r.ravel() for r in routings])) * e
        logits = linear(f"routing_{layer}", relu(gate))
        routing = np.zeros((n, n))
        for j in range(n):
            routing[j] = softmax(logits[j * n : (j + 1) * n])
        routings.append(routing)
        mixed = []
        for j in range(n):
            u = np.zeros(WIDTH)
            for i in range(n):
                u = u + routing[j, i] * outputs[i]
            mixed.append(layer_norm(f"module_norm_{layer}", relu(u)))
        outputs = [module(layer, j, mixed[j]) for j in range(n)]
    gate = linear("routing_in_final", np.concatenate([r.ravel() for r in routings])) * e
    final = softmax(linear("routing_final", relu(gate)))
    y = np.zeros(WIDTH)
    for i in range(n):
        y = y + final[i] * outputs[i]
    return linear("head", relu(y)), np.stack(routings), final


@pytest.mark.parametrize(
    ("layers", "modules", "router_input", "trunk_input", "norm", "temperature"),
    [
        (2, 2, "z*obs", "obs", False, 1.0),
        (2, 2, "z*obs", "obs", True, 1.0),
        (3, 3, "z*obs", "obs", False, 2.0),
        (4, 3, "z", "obs_z", True, 1.0),
    ],
)
def test_soft_modular_forward_matches_loops(
    layers, modules, router_input, trunk_input, norm, temperature
):
    net = make_net(layers, modules, router_input, trunk_input, norm, temperature)
    rng = np.random.default_rng(0)
    x = rng.normal(size=(TASKS, BATCH, FEATURES)).astype(np.float32)
    z = rng.normal(size=(TASKS, 1, LATENT)).astype(np.float32)
    params = spread(net.init(jax.random.key(0), x, z))
    result: Any = net.apply(params, x, z)
    y, routing = result
    assert y.shape == (TASKS, BATCH, OUT)
    per_sample = 1 if router_input == "z" else BATCH
    assert routing.matrices.shape == (TASKS, per_sample, layers - 1, modules, modules)
    assert routing.final.shape == (TASKS, per_sample, modules)
    np.testing.assert_allclose(np.sum(routing.matrices, axis=-1), 1.0, atol=1e-6)
    np.testing.assert_allclose(np.sum(routing.final, axis=-1), 1.0, atol=1e-6)
    for i in range(TASKS):
        for b in range(BATCH):
            expected = forward_by_loops(
                params["params"], x[i, b], z[i, 0], layers, modules, router_input, trunk_input,
                norm, temperature,
            )  # fmt: skip
            at = min(b, per_sample - 1)
            np.testing.assert_allclose(y[i, b], expected[0], rtol=2e-4, atol=2e-5)
            np.testing.assert_allclose(routing.matrices[i, at], expected[1], atol=1e-5)
            np.testing.assert_allclose(routing.final[i, at], expected[2], atol=1e-5)


def range_of(leaf):
    return float(np.max(np.abs(leaf)))


def test_official_initial_ranges_scale_with_the_number_of_outputs():
    """Kernels (in, out) fill U(+-1/sqrt(out)); in and out differ, so fan-in would fail."""
    net = replace(make_net(2, 2), trunk_width=16, gating_width=64, module_width=25)
    p = net.init(jax.random.key(1), jnp.zeros((1, 200)), jnp.zeros((1, 100)))["params"]
    hidden = {"trunk_0": 16, "trunk_1": 16, "embedding": 16, "gating_0": 64, "gating_1": 64}
    for name, outputs in (hidden | {"routing_in_final": 64, "modules_0": 25}).items():
        bound = 1.0 / np.sqrt(outputs)
        assert 0.9 * bound < range_of(p[name]["kernel"]) <= bound, name
        assert np.all(p[name]["bias"] == np.float32(0.1)), name
    for name in ("head", "routing_1", "routing_final"):
        assert 0.8 * 3e-3 < range_of(p[name]["kernel"]) <= 3e-3, name
        assert 0 < range_of(p[name]["bias"]) <= 3e-3, name


def test_flax_initial_ranges():
    net = replace(make_net(2, 2), initialisers=make_initialisers("flax"), module_width=25)
    p = net.init(jax.random.key(1), jnp.zeros((1, 200)), jnp.zeros((1, 100)))["params"]
    for name, inputs in {"trunk_0": 200, "embedding": 100, "modules_1": 25}.items():
        bound = np.sqrt(6.0 / inputs)
        assert 0.9 * bound < range_of(p[name]["kernel"]) <= bound, name
        assert np.all(p[name]["bias"] == 0.0), name
    assert 0.5e-3 < range_of(p["routing_1"]["kernel"]) <= 1e-3
    assert np.all(p["routing_final"]["bias"] == 0.0)


def tiny_config(**model):
    sizes = {"mlp_hidden": (8, 8), "modules": (2, 2, 4), "trunk_width": 8, "gating_width": 4}
    encoder = EncoderConfig(hidden=(8,), latent_dim=LATENT, goal_width=3)
    return replace(Config(), model=ModelConfig(**(sizes | model)), encoder=encoder)


@pytest.mark.parametrize("net", ["soft", "mlp"])
def test_one_z_per_task_equals_z_repeated_for_every_sample(net):
    networks = make_networks(tiny_config(net=net, trunk_input="obs_z"), FEATURES, 2, 7, TASKS)
    params = spread(networks.init_actor(jax.random.key(0)))
    obs, z = (jax.random.normal(jax.random.key(i), s) for i, s in [(1, (2, 3, 5)), (2, (2, 4))])
    broadcast = networks.actor(params, obs, z[:, None])
    repeated = networks.actor(params, obs, jnp.repeat(z[:, None], BATCH, axis=1))
    np.testing.assert_allclose(broadcast[0], repeated[0], rtol=1e-5)
    assert not np.allclose(broadcast[0], networks.actor(params, obs, 1.5 * z[:, None])[0])


def test_twin_critics_are_independent_and_have_their_own_start():
    networks = make_networks(tiny_config(), FEATURES, 2, 7, TASKS)
    params = jit_once(networks.init_critic)(jax.random.key(0))
    kernels = params["params"]["trunk_0"]["kernel"]
    assert kernels.shape[0] == 2 and not np.allclose(kernels[0], kernels[1])
    obs, action, z = jnp.ones((TASKS, BATCH, 5)), jnp.ones((TASKS, BATCH, 2)), jnp.ones((2, 1, 4))
    first = lambda params: jnp.sum(networks.critic(params, obs, action, z)[0])
    gradient = jit_once(jax.grad(first))(spread(params))
    assert any(range_of(g[0]) > 0 for g in jax.tree.leaves(gradient))
    assert all(range_of(g[1]) == 0 for g in jax.tree.leaves(gradient))


def test_conditioning_widths_and_switches():
    shapes = {"z": LATENT, "task_id": 3, "none": 0}
    for conditioning, width in shapes.items():
        cfg = tiny_config(net="mlp", conditioning=conditioning)
        networks = make_networks(cfg, FEATURES, 2, 7, 3)
        assert networks.conditioning_size == width
        assert (networks.init_encoder is None) == (conditioning != "z")
        params = networks.init_actor(jax.random.key(0))
        assert params["params"]["Linear_0"]["kernel"].shape == (FEATURES + width, 8)
        networks.actor(params, jnp.ones((2, FEATURES)), jnp.ones((2, width)))
    networks = make_networks(tiny_config(modular_actor=False), FEATURES, 2, 7, 3)
    mean, log_std, routing = networks.actor(
        networks.init_actor(jax.random.key(0)), jnp.ones((2, FEATURES)), jnp.ones((2, LATENT))
    )
    assert routing is None and mean.shape == log_std.shape == (2, 2)
    with pytest.raises(ValueError, match="at least 2 module layers"):
        make_networks(tiny_config(modules=(1, 2, 4)), FEATURES, 2, 7, 3)


def test_log_std_is_clipped():
    networks = make_networks(tiny_config(net="mlp"), FEATURES, 2, 7, 3)
    params = jax.tree.map(lambda x: 50.0 * x, spread(networks.init_actor(jax.random.key(0))))
    obs = 100.0 * jax.random.normal(jax.random.key(1), (64, FEATURES))
    _, log_std, _ = networks.actor(params, obs, jnp.ones((64, LATENT)))
    assert float(jnp.min(log_std)) == -20.0 and float(jnp.max(log_std)) == 2.0
