"""Intervals and averages of success rates: Wilson over goals, IQM with a bootstrap over seeds.

A rate over 50 goals is a binomial proportion: resampling 50 successes can only give 50 successes,
so a bootstrap reports [1.00, 1.00], while Wilson's score interval says [0.93, 1.00]. Several seeds
together are summarised by the interquartile mean with a stratified bootstrap, as rliable does
(Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice").
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

RESAMPLES = 2000
Z_95 = 1.959963984540054  # standard normal quantile at 0.975

Interval = tuple[float, float]


def wilson_interval(rate: float, count: int) -> Interval:
    """95 % score interval of a proportion (Wilson 1927), within [0, 1].

    Args:
        rate: share of successes. Where each trial is itself a mean of draws (a goal's draws of z),
            their mean; the interval is then the conservative one of a single draw.
        count: trials.
    """
    square = Z_95**2 / count
    centre = (rate + square / 2) / (1 + square)
    half = np.sqrt(rate * (1 - rate) * square + square**2 / 4) / (1 + square)
    return max(0.0, float(centre - half)), min(1.0, float(centre + half))


def mean_interval(values: np.ndarray) -> Interval:
    """95 % percentile bootstrap interval of the mean of values (goal,) that are no proportion."""
    generator = np.random.default_rng(0)
    index = generator.integers(0, len(values), (RESAMPLES, len(values)))
    return _percentiles(values[index].mean(1))


def interquartile_mean(values: ArrayLike, axis: int = -1) -> np.ndarray:
    """Mean of the middle half of the values along an axis.

    The values at both edges of the half count by the share of them that lies inside, so that five
    seeds use 2.5 of them; scipy's trim_mean would round that to three.
    """
    ordered = np.sort(np.moveaxis(np.asarray(values, float), axis, -1), -1)
    count = ordered.shape[-1]
    edges = np.arange(count + 1) / count
    inside = np.clip(np.minimum(edges[1:], 0.75) - np.maximum(edges[:-1], 0.25), 0.0, None)
    return ordered @ (inside / inside.sum())


def seeds_interval(scores: Sequence[np.ndarray]) -> tuple[float, Interval]:
    """IQM over the seeds' rates, and its 95 % interval by a stratified bootstrap.

    Seeds are drawn with replacement, and goals within each seed drawn: both are samples of what
    might have been run. With several strata (tasks or folds) each is resampled by itself, and the
    IQM is taken over the rates of all of them.

    Args:
        scores: of each stratum, (seed, goal) scores.

    Returns:
        The IQM of the rates as they are, and the interval.
    """
    generator = np.random.default_rng(0)
    rates = [values.mean(1) for values in scores]
    resampled = []
    for values in scores:
        seeds, goals = values.shape
        seed = generator.integers(0, seeds, (RESAMPLES, seeds, 1))
        goal = generator.integers(0, goals, (RESAMPLES, seeds, goals))
        resampled.append(values[seed, goal].mean(2))
    middle = interquartile_mean(np.concatenate(rates))
    return float(middle), _percentiles(interquartile_mean(np.concatenate(resampled, 1)))


def seeds_band(curves: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """IQM over seeds at every point, and its 95 % bootstrap interval over seeds.

    Args:
        curves: (seed, point) figures of equally many goals or episodes each.

    Returns:
        The IQM, the interval's lower and its upper end, (point,) each.
    """
    generator = np.random.default_rng(0)
    index = generator.integers(0, len(curves), (RESAMPLES, len(curves)))
    resampled = interquartile_mean(curves[index], axis=1)  # (resample, point)
    low, high = np.quantile(resampled, (0.025, 0.975), axis=0)
    return interquartile_mean(curves, axis=0), low, high


def _percentiles(values: np.ndarray) -> Interval:
    low, high = np.quantile(values, (0.025, 0.975))
    return float(low), float(high)
