"""Courses over the box, and the interval beside the Kalman filter's band."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from jax import Array

from experiments.positive_control import estimates
from experiments.positive_control.system import A_HIGH, X0, B, C, contraction, rollout


def courses(keys: Array, gains: Mapping[str, np.ndarray], path: Path) -> Path:
    """200 draws with each gain: the first state and both inputs, with the bound c gamma^k lambda."""
    fig, axes = plt.subplots(2, 2, figsize=(10, 6), sharex=True, constrained_layout=True)
    for column, (name, K) in enumerate(gains.items()):
        drawn = rollout(keys[:200], jnp.asarray(K), jnp.asarray(X0), varying=False)
        k = np.arange(drawn.x.shape[1])
        axes[0, column].plot(k, np.asarray(drawn.x[..., 0]).T, color="tab:blue", lw=0.4, alpha=0.3)
        gamma, weights = contraction(A_HIGH + B @ K @ C)
        bound = (X0 / weights).max() * gamma**k * weights[0]
        axes[0, column].plot(k, bound, "k--", lw=1.2, label=f"bound, γ = {gamma:.3f}")
        axes[0, column].set(title=f"{name}, constant A", ylabel="x1", ylim=(0, 3.2))
        for i, color in enumerate(("tab:orange", "tab:green")):
            u = np.asarray(drawn.u[..., i]).T
            axes[1, column].plot(k[:-1], u[:, 1:], color=color, lw=0.4, alpha=0.3)
            axes[1, column].plot(k[:-1], u[:, 0], color=color, lw=1, label=f"u{i + 1}")
        axes[1, column].set(xlabel="step", ylabel="input")
        for axis in axes[:, column]:
            axis.legend(fontsize=8)
            axis.grid(alpha=0.3)
    fig.savefig(path, dpi=120)
    plt.close(fig)
    return path


def bands(seed: int, gains: Mapping[str, np.ndarray], path: Path) -> Path:
    """One run with each gain: the interval and the Kalman filter's 3 sigma before each sample."""
    fig, axes = plt.subplots(2, 1, figsize=(10, 6), sharex=True, constrained_layout=True)
    v = 0.02
    for axis, (name, K) in zip(axes, gains.items(), strict=True):
        keys = jax.random.key(seed)[None]
        run = estimates.simulate(keys, jnp.asarray(K), estimates.observer(v), estimates.kalman(v), jnp.asarray(v))
        k = np.arange(60, 140)
        x, lower, upper, prior, deviation = (
            np.asarray(part)[0, k, 0] for part in (run.x, run.lower, run.upper, run.prior, run.deviation)
        )
        axis.fill_between(k, lower, upper, color="0.85", label="interval")
        axis.fill_between(k, prior - 3 * deviation, prior + 3 * deviation, color="tab:blue", alpha=0.35, lw=0,
                          label="Kalman filter, 3 sigma")  # fmt: skip
        out = np.abs(x - prior) > 3 * deviation
        axis.plot(k, x, "k", lw=1.2, label="true")
        axis.plot(k[out], x[out], "o", color="tab:red", ms=4, label="outside 3 sigma")
        axis.set(ylabel="x1", title=f"{name}, noise of y within ±{v}")
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8, ncols=4, loc="upper left")
    axes[1].set(xlabel="step")
    fig.savefig(path, dpi=120)
    plt.close(fig)
    return path
