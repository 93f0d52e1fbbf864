"""Compositional meta-RL (CMRL) on Meta-World scenes, end to end in JAX."""

__version__ = "0.1.0"
