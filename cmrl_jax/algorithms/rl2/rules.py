"""What the program asks of an RL2 configuration before jax is imported."""

from __future__ import annotations

from cmrl_jax.algorithms.rules import AlgorithmRules, check_lanes
from cmrl_jax.config.schema import require


class Rules(AlgorithmRules):
    """Answers about one RL2 configuration, see `AlgorithmRules`."""

    IDLE = (
        "model.",
        "encoder.",
        "kl.",
        "sac.",
        "collect.",
        "maml.",
        "ppo.gamma",
        "ppo.gae_lambda",
        "ppo.clip",
        "ppo.epochs",
        "ppo.lr",
        "ppo.grad_clip",
        "ppo.entropy",
        "ppo.std_init",
        "rl2.episodes",
        "rl2.minibatches",
        "rl2.value_weight",
    )
    seed_and_length_shape = False
    adapts = True
    ways = ("hidden-state",)
    on_bad_gradients = "start a new run with a lower ppo.lr"

    def steps_per_iteration(self) -> int:
        """A trial of every lane."""
        return super().steps_per_iteration() * self.config.rl2.episodes

    def check(self) -> None:
        """Raises ConfigError for the first combination that cannot be trained."""
        lanes, parts = self.config.collect.lanes, self.config.rl2.minibatches
        cause = f"collect.lanes {lanes} cannot be divided into {parts} minibatches of lanes"
        fits = max(n for n in range(1, min(lanes, parts) + 1) if lanes % n == 0)
        require(lanes % parts == 0, cause, f"set rl2.minibatches: {fits}")
        super().check()

    def check_devices(self, devices: int) -> None:
        """Raises ConfigError unless the lanes divide evenly among the devices."""
        check_lanes(self.config, devices)
