"""Gradients through particle filters: bias and variance of each scheme against the Kalman filter's exact gradient."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from jax import Array

import jaxfilt as jf
from experiments.report import Cell, Entry, Options, Report, Table

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TITLE = "Gradients through a particle filter"
MAIN = False

T = 25
TRUE = (2.0, 10.0)  # standard deviations of the acceleration [m/s^2] and of a measured coordinate [m]
ASSUMED = (2.0, 12.0)  # where the gradient is taken; at the true ones it would be near zero
M0, P0 = np.array([0.0, 0.0, 10.0, 5.0]), np.diag([100.0, 100.0, 4.0, 4.0])
SERIES = 1  # one series for all; seeds are those of the filter's draws
SWEEPS = 30
COUNTS = (100, 300, 1000, 2000)


class Scheme(NamedTuple):
    """How gradients pass a resampling."""

    gradient: str
    alpha: float = 0.5
    epsilon: float = 0.25


SCHEMES = {
    "naive": Scheme("none"),
    "soft, alpha 0.9": Scheme("soft", alpha=0.9),
    "soft, alpha 0.5": Scheme("soft", alpha=0.5),
    "score": Scheme("score"),
    "full score": Scheme("full_score"),
    "transport, epsilon 0.25": Scheme("transport", epsilon=0.25),
    "transport, epsilon 0.5": Scheme("transport", epsilon=0.5),
}
SYSTEMATIC = ("naive", "score")  # the schemes that are also shown with systematic draws


class Case(NamedTuple):
    """One row: a scheme, how ancestors are drawn, and the number of particles."""

    scheme: str
    draws: str
    count: int


def cases(quick: bool) -> list[Case]:
    """The rows of the table; transport up to 300 particles, since it costs the square of their number."""
    counts = COUNTS[:1] if quick else COUNTS
    rows = []
    for name, scheme in SCHEMES.items():
        moved = scheme.gradient == "transport"
        rows += [Case(name, "none" if moved else "multinomial", N) for N in counts if N <= 300 or not moved]
        if name in SYSTEMATIC:
            rows += [Case(name, "systematic", N) for N in counts if N in (100, 2000)]
    return rows


def model(theta: Array) -> jf.models.LinearGaussian:
    """Constant velocity in a plane, positions measured each second; theta = log (sigma_w, sigma_z)."""
    q, r = jnp.exp(2 * theta)
    return jf.models.constant_velocity(dt=1.0, q=q, r=r, m0=M0, P0=P0, noise="piecewise")


def series() -> Array:
    """(T, 2) positions measured of one target [m]."""
    rng = np.random.default_rng(SERIES)
    x = rng.multivariate_normal(M0, P0)
    position, velocity, ys = x[:2], x[2:], []
    for _ in range(T):
        a = TRUE[0] * rng.normal(size=2)
        position, velocity = position + velocity + a / 2, velocity + a
        ys.append(position + TRUE[1] * rng.normal(size=2))
    return jnp.array(ys)


@jax.jit
@partial(jax.value_and_grad, argnums=0)
def exact(theta: Array, ys: Array) -> Array:
    """The Kalman filter's log-likelihood and its gradient (2,)."""
    return jf.filter(jf.kalman(model(theta)), ys).log_lik.sum()


@partial(jax.jit, static_argnames=("gradient", "draws", "count", "batch"))
def estimates(theta, ys, keys, alpha, epsilon, *, gradient, draws, count, batch):
    """Log-likelihood (runs,) and gradient (runs, 2) of particle filters that resample in every step."""

    def one(theta, key):
        filt = jf.particle(
            model(theta), count, resampling=draws, threshold=1.0, gradient=gradient, alpha=alpha, epsilon=epsilon,
            sweeps=SWEEPS,
        )  # fmt: skip
        return jf.filter(filt, ys, key=key).log_lik.sum()

    return jax.lax.map(lambda key: jax.value_and_grad(one)(theta, key), keys, batch_size=batch)


class Sample(NamedTuple):
    """What a case's runs gave."""

    log_lik: np.ndarray  # (runs,)
    gradient: np.ndarray  # (runs, 2)
    seconds: float  # per run, without compilation


def sample(case: Case, runs: int, seed: int) -> Sample:
    """Runs of one case, each with its own draws."""
    scheme = SCHEMES[case.scheme]
    moved = scheme.gradient == "transport"
    if moved:
        runs = max(runs * 12 // case.count, 8)  # its cost grows with the square of the number of particles
    batch = min(runs, max(1, (1000 if moved else 20_000) // case.count))
    theta, keys = jnp.log(jnp.array(ASSUMED)), jax.random.split(jax.random.key(seed), runs)
    arguments = (theta, series(), keys, scheme.alpha, scheme.epsilon)
    draws = "systematic" if moved else case.draws
    compiled = estimates.lower(
        *arguments, gradient=scheme.gradient, draws=draws, count=case.count, batch=batch
    ).compile()
    start = time.perf_counter()
    log_lik, gradient = jax.block_until_ready(compiled(*arguments))
    return Sample(np.asarray(log_lik), np.asarray(gradient), (time.perf_counter() - start) / runs)


def simulate(rows: list[Case], runs: int, seed: int) -> dict[Case, Sample]:
    """All cases; the same keys for each."""
    return {case: sample(case, runs, seed) for case in rows}


def mean(x: np.ndarray, exactly: float = 0.0) -> Cell:
    """The mean over runs less the exact value, with its standard error."""
    return Cell(x.mean() - exactly, x.std(ddof=1) / np.sqrt(len(x)))


def table(samples: dict[Case, Sample]) -> Table:
    """Bias, its standard error, and the spread of a single run."""
    value, slope = exact(jnp.log(jnp.array(ASSUMED)), series())
    rows: list[list[Entry]] = []
    for case, found in samples.items():
        naive = samples.get(Case("naive", "multinomial", case.count))
        rows.append(
            [
                case.scheme, case.draws, f"{case.count}", f"{len(found.log_lik)}",
                mean(found.log_lik, float(value)),
                *(mean(found.gradient[:, i], float(slope[i])) for i in (0, 1)),
                *(Cell(found.gradient[:, i].std(ddof=1), digits=2) for i in (0, 1)),
                "-" if naive is None else Cell(found.seconds / naive.seconds, digits=2),
            ]
        )  # fmt: skip
    header = [
        "scheme", "draws", "N", "runs", "bias of log L", "bias, sigma_w", "bias, sigma_z", "sd, sigma_w", "sd, sigma_z",
        "time",
    ]  # fmt: skip
    note = (
        f"Gradient of log L by the logarithms of sigma_w and sigma_z; exact (Kalman): log L {float(value):.3f}, "
        f"gradient ({float(slope[0]):.3f}, {float(slope[1]):.3f}). sd: of a single run. time: of a run with its "
        "gradient, in units of the naive scheme's with as many particles."
    )
    return Table("gradients", "Bias and spread of the gradient", header, rows, note)


def findings(samples: dict[Case, Sample]) -> list[str]:
    """What the table says."""
    _, slope = exact(jnp.log(jnp.array(ASSUMED)), series())
    largest = max(case.count for case in samples)

    def relative(name, draws="multinomial", N=largest):
        bias = mean(samples[Case(name, draws, N)].gradient[:, 1], float(slope[1]))
        percent = 100 / abs(float(slope[1]))
        return f"{Cell(percent * float(bias.value), percent * float(bias.se), digits=2)} %"  # pyright: ignore[reportArgumentType]

    def spread(name, i, N=largest):
        return f"{samples[Case(name, 'multinomial', N)].gradient[:, i].std(ddof=1):.2g}"

    sentences = [
        f"With {largest} particles the derivative by log sigma_z is off by {relative('naive')} of the exact value "
        f"where autodiff ignores the draw of ancestors, by {relative('soft, alpha 0.9')} and "
        f"{relative('soft, alpha 0.5')} with soft resampling (alpha 0.9 and 0.5), by {relative('score')} with the "
        f"score correction and {relative('full score')} with the score form of the process noise too.",
        f"The price is variance: standard deviation of one run's derivatives by (log sigma_w, log sigma_z) with "
        f"{largest} particles {spread('naive', 0)} and {spread('naive', 1)} (naive), {spread('score', 0)} and "
        f"{spread('score', 1)} (score), {spread('full score', 0)} and {spread('full score', 1)} (full score).",
    ]
    moved = [case for case in samples if case.draws == "none"]
    N = max(case.count for case in moved)
    parts = []
    for case in moved:
        if case.count == N:
            found = samples[case]
            sd = found.gradient.std(axis=0, ddof=1)
            parts.append(
                f"{case.scheme.split(', ')[1]}: log L off by "
                f"{mean(found.log_lik, float(exact(jnp.log(jnp.array(ASSUMED)), series())[0]))}, derivative by log "
                f"sigma_z by {relative(case.scheme, 'none', N)}, standard deviations {sd[0]:.2g} and {sd[1]:.2g}"
            )
    sentences.append(f"Transport with {N} particles: {'; '.join(parts)}.")
    if Case("score", "systematic", largest) in samples:
        sentences.append(
            f"With systematic draws the score correction is an approximation: {relative('score', 'systematic')} with "
            f"{largest} particles (naive {relative('naive', 'systematic')})."
        )
    return sentences


def figure(where: Path, samples: dict[Case, Sample]) -> Path:
    """Bias and spread over the number of particles."""
    _, slope = exact(jnp.log(jnp.array(ASSUMED)), series())
    fig, axes = plt.subplots(1, 2, figsize=(11, 4.5), constrained_layout=True, sharex=True)
    for i, name in enumerate(SCHEMES):
        chosen = [case for case in samples if case.scheme == name and case.draws != "systematic"]
        N = np.array([case.count for case in chosen]) * 1.03 ** (i - 3)  # side by side
        cells = [mean(samples[case].gradient[:, 1], float(slope[1])) for case in chosen]
        axes[0].errorbar(
            N,
            [float(c.value) for c in cells],
            [2 * float(c.se or 0) for c in cells],
            fmt="o-",
            ms=4,
            capsize=2,
            label=name,
        )
        axes[1].plot(N, [samples[case].gradient[:, 1].std(ddof=1) for case in chosen], "o-", ms=4, label=name)
    axes[0].axhline(0, color="k", lw=0.8)
    axes[0].set(
        xscale="log", xlabel="particles", ylabel="bias of d log L / d log sigma_z", title="bias, ± 2 standard errors"
    )
    axes[1].set(xscale="log", yscale="log", xlabel="particles", ylabel="standard deviation of one run", title="spread")
    axes[0].legend(fontsize=8)
    fig.savefig(where, dpi=120)
    plt.close(fig)
    return where


def run(options: Options) -> Report:
    """The whole experiment."""
    samples = simulate(cases(options.quick), options.count(400, 100), options.seed)
    report = Report("particle_gradients", TITLE, [table(samples)])
    report.findings = findings(samples)
    report.headline = report.findings[:1]
    report.figures = [figure(options.directory("particle_gradients") / "gradients.png", samples)]
    return report
