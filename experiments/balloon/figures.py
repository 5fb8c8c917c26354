"""The figures of the experiment."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

import jaxfilt as jf
from experiments.balloon import ascents, bursts, fronts
from experiments.balloon.settings import KALMAN, Scores, fuzzy_name, mixed_name
from experiments.balloon.system import UNIVERSE
from experiments.lost_target.tuning import Outcome
from experiments.lost_target.tuning_figures import LABELS

PUBLISHED = {"classical, published": 0.0245, "fuzzy, published": 0.0048}
_COLORS = {"gradient": "tab:blue", "genetic": "tab:orange", "nsga2": "tab:green"}
_METHODS = {"theta sweep": ("k", ".-"), "gradient, swept weights": ("tab:blue", "o"), "NSGA-II": ("tab:green", "^")}


def thetas(scores: Scores, shares: tuple[float, ...], where: Path) -> Path:
    """Mean RMSE against theta: what the published gain is."""
    fig, axes = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained", sharey=True)
    for ax, part in zip(axes, ("pred", "corrected"), strict=True):
        rmse = {name: 1000 * np.sqrt(s[part]).mean() for name, s in scores.items()}
        places = [1 - share for share in shares]
        ax.plot(places, [rmse[mixed_name(share)] for share in shares], "o-", color="tab:red", label="mixed")
        ax.axhline(rmse[KALMAN], color="k", label="Kalman (theta = 0)")
        ax.axhline(rmse[fuzzy_name("innovation")], color="tab:blue", ls="--", label="fuzzy mixed at 0.995")
        for (name, value), ls in zip(PUBLISHED.items(), (":", "-."), strict=True):
            ax.axhline(1000 * value, color="0.5", ls=ls, label=name)
        ax.set(xscale="log", title=f"estimates: {part}", xlabel="distance to the bound, 1 - theta / theta_max")
        ax.invert_xaxis()
        ax.grid(True, alpha=0.3)
    axes[0].set_ylabel("mean RMSE of all states [m, m/s, m/s²]")
    axes[0].legend(fontsize=8)
    return _save(fig, where / "balloon_theta.png")


def convergence(outcome: Outcome, where: Path) -> Path:
    """Excess of the training loss over wall time and evaluations, and the front."""
    fig, axes = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    lowest = outcome.lowest()
    for name, result in outcome.results.items():
        excess = np.maximum(result.history.best_loss - lowest, 1e-3)
        for ax, cost in zip(axes, (result.history.wall_time, result.history.evaluations), strict=False):
            ax.step(cost, excess, where="post", color=_COLORS[name], marker=".", ms=4, label=LABELS[name])
        x, y = outcome.objectives(name)[0]
        axes[2].plot(x, y, "os^"[list(LABELS).index(name)], color=_COLORS[name], mfc="none", ms=9,
                     label="NSGA-II, lowest mean" if name == "nsga2" else LABELS[name])  # fmt: skip
    for ax, label in zip(axes, ("wall time without compilation [s]", "evaluations of the loss"), strict=False):
        ax.set(xscale="log", yscale="log", xlabel=label, ylabel="loss above the lowest (at least 0.001) [1e-4 km²]")
    front = outcome.results["nsga2"].front
    assert front is not None
    axes[2].plot(*front.losses.T, ".", color=_COLORS["nsga2"], label="NSGA-II, front")
    axes[2].set(xlabel="mean MSE, training [1e-4 km²]", ylabel="95th percentile [1e-4 km²]")
    for ax in axes:
        ax.grid(True, alpha=0.3)
        ax.legend(fontsize=8)
    return _save(fig, where / "balloon_tuning.png")


def memberships(outcome: Outcome, where: Path) -> Path:
    """The sets before and after, and what they make of R and Q where all axes see the same innovation."""
    names = {"before (printed law)": "printed law (start)"} | {LABELS[name]: name for name in LABELS}
    fig, axes = plt.subplots(len(names), 4, figsize=(13, 2.4 * len(names)), layout="constrained")
    colors = plt.get_cmap("viridis")(np.linspace(0, 0.9, bursts.LEVELS))
    d = np.linspace(0.0, 100.0, 400)
    for row, (label, name) in zip(axes, names.items(), strict=True):
        params = outcome.params[name]
        for i, ax in enumerate(row[:3]):
            sets = _sets(params, i, jnp.asarray(d))
            for j, color in enumerate(colors):
                ax.plot(d, sets[:, j], color=color, label=("LV", "MV", "HV", "VHV")[j])
            ax.axvspan(UNIVERSE[i], d[-1], color="0.93")
            ax.set(title=f"{label}: {'xyz'[i]}", xlabel="mean innovation [m]", ylim=(-0.03, 1.03))
        weights = jnp.stack([_sets(params, i, jnp.asarray(d)) for i in range(3)], axis=1)
        weights = np.asarray(jax.vmap(jf.fuzzy.minimum_weights)(weights))
        for key, color in (("log_alpha_r", "tab:red"), ("log_alpha_q", "tab:blue")):
            row[3].plot(d, np.exp(-weights @ np.asarray(params[key])), color=color, label=f"{key[-1].upper()} times")
        row[3].set(title="factors, alike on all axes", xlabel="mean innovation [m]", yscale="log")
        row[3].legend(fontsize=7)
    axes[0, 0].legend(fontsize=7)
    for ax in axes[:, 0]:
        ax.set_ylabel("membership")
    return _save(fig, where / "balloon_memberships.png")


def _sets(params: Mapping[str, Any], axis: int, d: Any) -> np.ndarray:
    centers = jnp.cumsum(jnp.asarray(params["gaps"])[axis])
    return np.asarray(jf.fuzzy.stick_breaking(d, centers[None, :], jnp.asarray(params["widths"])[axis][None, :]))


def pareto(found: Mapping[str, Mapping[str, fronts.Found]], where: Path) -> Path:
    """The fronts of the three problems."""
    fig, axes = plt.subplots(1, len(found), figsize=(4.6 * len(found), 4.4), layout="constrained", squeeze=False)
    for ax, (problem, methods) in zip(axes[0], found.items(), strict=True):
        unit = 1.0 if problem == fronts.SCALAR else 1e-4
        if problem == fronts.SCALAR:
            K = np.linspace((np.sqrt(5) - 1) / 2, 1.0, 200)
            ax.plot(*fronts.closed_form(K).T, color="0.7", lw=4, label="closed form")
        for name, method in methods.items():
            color, style = _METHODS[name]
            label = f"{name}: {method.evaluations} evaluations, {method.wall:.2g} s"
            ax.plot(*(method.points / unit).T, style, color=color, mfc="none", ms=5, label=label)
        if problem == fronts.ROBUST:
            points = np.concatenate([m.points for n, m in methods.items() if n != "theta sweep"]) / unit
            low, high = points.min(axis=0), np.array([2.2, 4.8])
            ax.set(xlim=(0.98 * low[0], high[0]), ylim=(0.95 * low[1], high[1]))
            ax.set(xlabel="mean MSE over mismatch [1e-4 km²]", ylabel="95th percentile [1e-4 km²]")
        else:
            power = "" if unit == 1.0 else " [1e-4]"
            ax.set(xlabel=f"J2, mean square{power}", ylabel=f"J_inf, worst case{power}")
        ax.set_title(problem)
        ax.grid(True, alpha=0.3)
        ax.legend(fontsize=7)
    return _save(fig, where / "balloon_fronts.png")


def recorded(outcome: Mapping[str, Mapping[str, ascents.Scores]], drawn: ascents.Groups, where: Path) -> Path:
    """Errors in gaps against their length."""
    fig, axes = plt.subplots(2, 2, figsize=(12.5, 7.5), layout="constrained")
    for column, (name, scores) in zip(axes.T, outcome.items(), strict=True):
        for ax, part, label in zip(
            column, ("horizontal", "height"), ("horizontal position", "height"), strict=True
        ):  # fmt: skip
            for i, (filt, score) in enumerate(scores.items()):
                rmse = [drawn.gaps[n].draw(*ascents.in_gaps(getattr(score, part)))[0] for n in ascents.LENGTHS]
                style = ":" if filt in ascents.NAIVE else "-"
                ax.plot(ascents.LENGTHS, rmse, style, marker="osv^Dx+*1"[i % 9], ms=4, label=filt)
            ax.set(xscale="log", yscale="log", title=name, xlabel="hidden samples, 1 s apart")
            ax.set_ylabel(f"RMSE over the gap, {label} [m]")
            ax.set_xticks(ascents.LENGTHS, [str(n) for n in ascents.LENGTHS], minor=False)
            ax.xaxis.set_minor_formatter(NullFormatter())
            ax.grid(True, alpha=0.3)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside right upper", fontsize=8)
    return _save(fig, where / "balloon_ascents.png")


def _save(figure: Figure, path: Path) -> Path:
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path
