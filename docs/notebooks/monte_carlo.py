# %% [markdown]
# # A hundred thousand Monte Carlo runs
#
# How good is a filter, and is its covariance true? One run does not tell. `jf.monte_carlo` simulates and filters runs
# in compiled chunks that fit memory, scores each, shows a bar, and goes on where it was interrupted. Its random numbers
# depend on the key and on the run's number only, so the result is the same for any chunk size and any number of
# devices.

# %% tags=["parameters"]
runs = 100_000

# %%
import tempfile

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import jaxfilt as jf

# %% [markdown]
# ## The scenario
#
# A target in the plane with nearly constant velocity, positions measured each second, ten of them lost. `jf.scenario`
# draws the truth from the model. The filters under test may believe in another one: here one is right, one has a
# process noise ten times too small, one is the alpha-beta filter with the gains that are optimal in the long run.

# %%
T = 60
mask = jf.simulate.gap_mask(T, (30, 39))


def motion(q):
    prior = {"m0": np.array([0.0, 0.0, 10.0, 5.0]), "P0": np.diag([100.0, 100.0, 25.0, 25.0])}
    return jf.models.constant_velocity(dt=1.0, q=q, r=25.0, **prior)


q = 1.0
alpha, beta = jf.gains.kalata(float(np.sqrt(q / 25.0)))
filters = {
    "Kalman": jf.kalman(motion(q)),
    "Kalman, q / 10": jf.kalman(motion(q / 10)),
    "alpha-beta": jf.alpha_beta(alpha, beta, dt=1.0, m0=np.array([0.0, 0.0, 10.0, 5.0])),
}
scenario = jf.scenario(motion(q), T, mask=mask)

# %% [markdown]
# ## The score
#
# A function of one run's truth, measurements and output. What it does not use is not computed, and only what it returns
# leaves the compiled chunk. NEES is there only where there is a covariance.


# %%
def score(truth, ys, out):
    error = out.mean - truth
    found = {"squared": jnp.sum(error[:, :2] ** 2, axis=1)}  # (T,) m²
    if out.cov is not None:
        found["nees"] = jf.metrics.nees(out.mean, out.cov, truth)
    return found


with tempfile.TemporaryDirectory() as folder:
    options = {"key": jax.random.key(0), "checkpoint": folder}
    part = jf.monte_carlo(scenario, filters, score, runs // 4, **options)
    result = jf.monte_carlo(scenario, filters, score, runs, progress=True, **options)

# %% [markdown]
# The first call did a quarter of the runs, the second took them from the checkpoint and did the rest. Interrupt it and
# call it again: it goes on in the same way.

# %%
same = np.array_equal(part.scores["Kalman"]["nees"], result.scores["Kalman"]["nees"][: runs // 4])
steps = runs * T * len(filters)
print(f"{result.runs} runs in chunks of {result.chunk}; the quarter is the same to the bit: {same}")
speed = part.runs_per_second
print(f"{speed:,.0f} runs/s, that is {speed * T * len(filters) / 1e6:.1f} million filter steps/s; "
      f"compiled in {part.compile_seconds:.1f} s")  # fmt: skip

# %% [markdown]
# ## Errors with confidence bands
#
# RMSE over the runs; the band holds the true RMSE with 95 %. With as many runs it is thinner than the line.

# %%
curves = {name: scores["squared"] for name, scores in result.scores.items()}
few = {name: squared[:100] for name, squared in curves.items()}
figure, axes = plt.subplots(1, 2, figsize=(12, 4.5), layout="constrained", sharey=True)
for ax, shown in zip(axes, (few, curves), strict=True):
    jf.plots.monte_carlo(shown, root=True, unit="m", ax=ax)
plt.show()

# %% [markdown]
# ## Is the covariance true?
#
# The NEES averaged over the runs must lie in a narrow region around 4, the dimension of the state. With this many runs
# an error of a percent shows.

# %%
figure, axes = plt.subplots(2, 1, figsize=(9, 6.5), layout="constrained", sharex=True)
for ax, name in zip(axes, ("Kalman", "Kalman, q / 10"), strict=True):
    jf.plots.consistency(result.scores[name]["nees"], 4, label=f"NEES, {name}", ax=ax)
plt.show()

# %%
rows = {}
for name, scores in result.scores.items():
    after = scores["squared"][:, 45:].mean(axis=1)
    rmse = jf.metrics.root_mean(after)
    rows[name] = {"RMSE after the gap [m]": float(rmse.value), "± s.e.": float(rmse.standard_error)}
    if "nees" in scores:
        verdict = jf.metrics.consistency(scores["nees"], 4)
        rows[name] |= {"mean NEES": verdict.mean.mean(), "times inside 99.9 % [%]": 100 * verdict.inside.mean()}
pd.DataFrame(rows).T.round(4)

# %% [markdown]
# Compare filters on the same runs: the ratio's standard error is far smaller than that of unpaired runs.

# %%
kalman = result.scores["Kalman"]["squared"][:, 45:].mean(axis=1)
for name in ("Kalman, q / 10", "alpha-beta"):
    ratio = jf.metrics.ratio(result.scores[name]["squared"][:, 45:].mean(axis=1), kalman, root=True)
    print(f"RMSE of {name} over the Kalman filter's, after the gap: {ratio.value:.4f} ± {ratio.standard_error:.4f}")
missed = result.status_counts("Kalman")[jf.Status.MISSED]
print(f"status over all runs: {result.status_counts('Kalman')} (in {missed} runs samples were missing, as planned)")

# %% [markdown]
# ## What to take away
#
# * Shared things (the mask, here) belong into the scenario and not into the runs: covariances are then computed once
#   for all runs.
# * A `q` that is wrong by a factor of ten costs far more honesty than accuracy, and the NEES shows it.
# * Only scores leave the chunk: 100 000 runs of 60 steps and three filters need no more memory than the curves above.
#
# Next: the same call over several devices or processes (`jf.monte_carlo`, `jf.use_cores`); `experiments/lost_target`
# runs its tables this way.
