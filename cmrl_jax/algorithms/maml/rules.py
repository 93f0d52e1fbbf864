"""What the program asks of a MAML configuration before jax is imported."""

from __future__ import annotations

from cmrl_jax.algorithms.rules import AlgorithmRules, check_lanes
from cmrl_jax.config.schema import lanes_per_task, require


class Rules(AlgorithmRules):
    """Answers about one MAML configuration, see `AlgorithmRules`."""

    IDLE = (
        "model.",
        "encoder.",
        "kl.",
        "sac.",
        "collect.",
        "rl2.",
        "ppo.clip",
        "ppo.epochs",
        "ppo.lr",
        "ppo.grad_clip",
        "ppo.entropy",
        "ppo.std_init",
        "maml.inner_steps",
        "maml.kl",
    )
    seed_and_length_shape = False
    adapts = True
    ways = ("inner-steps",)
    on_bad_gradients = "start a new run with a lower ppo.lr or maml.inner_lr"

    def steps_per_iteration(self) -> int:
        """An episode of every lane before each inner step, and one after the last."""
        return super().steps_per_iteration() * (self.config.maml.inner_steps + 1)

    def check(self) -> None:
        """Raises ConfigError for the first combination that cannot be trained."""
        lanes, episodes = lanes_per_task(self.config), self.config.maml.episodes
        cause = f"the {lanes} lanes of a task are no groups of {episodes} (maml.episodes)"
        fits = max(n for n in range(1, min(lanes, episodes) + 1) if lanes % n == 0)
        require(
            lanes % episodes == 0, cause, f"set maml.episodes: {fits}, or another collect.lanes"
        )
        require(bool(self.config.maml.hidden), "maml.hidden is empty", "give at least one width")
        super().check()

    def check_devices(self, devices: int) -> None:
        """Raises ConfigError unless the lanes divide evenly among the devices."""
        check_lanes(self.config, devices)
