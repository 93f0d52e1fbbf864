"""What the program asks of a configuration's algorithm before jax is imported."""

from __future__ import annotations

import math
from dataclasses import replace

from cmrl_jax.config.schema import Config, require


class AlgorithmRules:
    """Answers about one configuration; an algorithm's own rules override what differs.

    Attributes:
        adapts: whether own episodes change what its policy does.
        ways: names of its agents (`Algorithm.agents`), by what own episodes change; the first is
            the default.
        reads_text: whether its policy is told a sentence.
        is_told_the_task: whether it is told which of its training tasks it acts on.
        can_start_from_text: whether the sentence alone says something before any episode.
        kind: what the answers come from, in words for a message.
        on_bad_gradients: what to do about a run whose gradients are not finite.
        seed_and_length_shape: whether its programs depend on the seed or on how long a run is.
        IDLE: keys, and with a dot whole sections, that training reads and a policy that acts does
            not.
    """

    IDLE: tuple[str, ...] = ()
    seed_and_length_shape = True
    adapts = False
    ways: tuple[str, ...] = ("none",)
    reads_text = False
    is_told_the_task = False
    can_start_from_text = False
    on_bad_gradients = "start a new run with a lower learning rate"

    def __init__(self, config: Config):
        self.config = config
        self.kind = f"algorithm {config.algorithm}"

    def steps_per_iteration(self) -> int:
        """Control steps of all lanes in a training iteration."""
        return self.config.collect.lanes * self.config.env.horizon

    def shaping(self) -> Config:
        """The configuration with what no program depends on at its default."""
        config, usual = self.config, Config()
        if not self.seed_and_length_shape:
            steps, minutes = usual.train.env_steps, usual.train.minutes
            length = replace(config.train, env_steps=steps, minutes=minutes)
            config = replace(config, seed=usual.seed, train=length)
        return replace(
            config,
            name=usual.name,
            eval=usual.eval,
            checkpoint=usual.checkpoint,
            log=usual.log,
            runtime=replace(config.runtime, compile_cache=usual.runtime.compile_cache),
        )

    def check(self) -> None:
        """Raises ConfigError for the first combination that cannot be trained.

        One that does not adapt can be scored on its training tasks alone, before any episode.
        """
        if self.adapts:
            return
        test, evaluation = self.config.tasks.test, self.config.eval
        cause = f"tasks.test is {list(test)} with {self.kind}, which does not adapt"
        require(not test, cause, "set tasks.test: []")
        for key, ks in (("eval.k", evaluation.k), ("eval.final_k", evaluation.final_k)):
            cause = f"{key} {list(ks)} with {self.kind}, which does not adapt"
            require(not any(ks), cause, f"set {key}: [0]")

    def check_devices(self, devices: int) -> None:
        """Raises ConfigError unless the work divides evenly among the devices."""


def check_lanes(config: Config, devices: int) -> None:
    """Raises ConfigError unless the lanes divide evenly among the devices."""
    lanes, multiple = config.collect.lanes, math.lcm(len(config.tasks.train), devices)
    cause = f"collect.lanes {lanes} cannot be divided among {devices} devices"
    cure = f"set collect.lanes: {-(-lanes // multiple) * multiple}, or show fewer devices "
    cure += "(CUDA_VISIBLE_DEVICES, JAX_NUM_CPU_DEVICES)"
    require(lanes % devices == 0, cause, cure)
