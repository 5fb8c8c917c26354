# %% [markdown]
# # First filter on your own CSV
#
# A file with times and positions, some of them missing, at intervals that are never the same: that is what most people
# have. This notebook takes such a file from the first look to a filtered and smoothed track with honest error bars.
#
# The data are the AIS reports of one ship in the Solent, from when it casts off, received at irregular times and with
# real gaps. To be able to say how good the estimates are, every third minute's positions are taken out of the file and
# kept aside. The reports also carry the ship's speed and course; the filter is not told, so these can judge its
# velocity.

# %% tags=["parameters"]
vessel = 10
steps = 100  # of gradient descent, to learn the noise

# %%
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import jaxfilt as jf

# %% [markdown]
# ## The file
#
# Three columns: seconds, and metres east and north of a fixed point. Missing rows have empty cells.

# %%
reports = pd.read_csv("experiments/data/ais_solent/ais_solent.csv").query("vessel == @vessel and t_s > 2400")
minute = (reports.t_s - reports.t_s.iloc[0]) // 60
hidden = (minute % 3 == 2).to_numpy()
file = Path(tempfile.mkdtemp()) / "my_track.csv"
columns = {"time": reports.t_s, "east": reports.east_m.where(~hidden), "north": reports.north_m.where(~hidden)}
pd.DataFrame(columns).to_csv(file, index=False)

# To use your own file, begin here: put its path and its column names.
track = pd.read_csv(file)
track.describe().round(1)

# %% [markdown]
# ## From table to arrays
#
# NaN means missing only if you say so: `jf.mask_nan` makes a mask of it. `jf.intervals` turns time stamps into the
# intervals that the filter steps over. JAX computes in single precision by default, so count positions from somewhere
# nearby: at a distance of 5000 km one float32 step is half a metre.

# %%
positions = track[["east", "north"]].to_numpy()
origin = positions[0]
ys, mask = jf.mask_nan(positions - origin)
dt = jf.intervals(track["time"].to_numpy(), first=10.0)
seen = np.asarray(mask).all(axis=1)
print(f"{len(ys)} reports, {seen.sum()} with a position; intervals {dt.min():.1f} to {dt.max():.0f} s")

# %% [markdown]
# ## A model and a filter
#
# The ship goes nearly straight: `jf.models.constant_velocity` with state east, north and their rates. `q` says how
# much its velocity wanders [m²/s³], `r` is the variance of a position [m²]. A model is a pytree and a filter too, so
# write the function that makes the filter from its parameters; everything below uses it.


# %%
def make(params):
    motion = {"dt": 10.0, "m0": np.zeros(4), "P0": np.diag([100.0, 100.0, 25.0, 25.0])}
    return jf.kalman(jf.models.constant_velocity(q=params["q"], r=params["r"], **motion))


options = {"mask": mask, "dt": dt, "first_update_only": True}  # the prior is at the first report
guess = {"q": 1.0, "r": 100.0}
out = jf.check(jf.filter(make(guess), ys, **options))
print(f"log-likelihood of the guess: {float(out.log_lik.sum()):.1f} nats")

# %% [markdown]
# `jf.check` reads the status bits of all steps and raises or warns if something went wrong; here nothing did.
#
# ## Let the data say how noisy they are
#
# The likelihood of what was seen depends on `q` and `r`. `jf.tune.gradient` climbs it: a parameter space, a loss, the
# data.


# %%
def loss(params, data):
    return jf.tune.innovation_nll(make(params), data["ys"][None], mask=mask, dt=dt, first_update_only=True)


space = {"q": jf.tune.positive(guess["q"]), "r": jf.tune.positive(guess["r"])}
found = jf.tune.gradient(loss, space, {"ys": ys}, key=jax.random.key(0), steps=steps)
q, r = float(found.params["q"]), float(found.params["r"])
print(f"q = {q:.4f} m²/s³, sqrt(r) = {np.sqrt(r):.1f} m after {found.evaluations} evaluations, {found.wall_time:.1f} s")

# %% [markdown]
# ## Filter and smooth
#
# The filter uses the past alone, as a tracker must. The smoother also uses the future, as a recording allows.

# %%
filt = make(found.params)
out = jf.check(jf.filter(filt, ys, **options))
smoothed = jf.smooth(filt, ys, **options)
truth = np.column_stack([reports.east_m, reports.north_m]) - origin

figure, axes = plt.subplots(1, 2, figsize=(12, 4.5), layout="constrained")
jf.plots.track(smoothed, measurements=ys, mask=mask, label="smoothed", ax=axes[0])
axes[0].set_title("track, 95 % ellipses")
jf.plots.estimate(out, component=2, truth=reports.sog_mps * np.sin(reports.cog_rad), times=track["time"],
                  mask=mask, label="filter", unit="m/s", ax=axes[1])  # fmt: skip
axes[1].set(ylabel="velocity east [m/s]", title="filtered velocity; truth: the ship's own report")
plt.show()

# %% [markdown]
# ## Does it keep its promises?
#
# The normalized innovation squared (NIS) of a consistent filter is a chi-square number with two degrees of freedom,
# step after step.

# %%
jf.plots.consistency(np.asarray(out.nis)[seen], 2, times=track["time"][seen], label="NIS")
plt.show()

# %% [markdown]
# ## The score on what was hidden
#
# RMSE at the positions that the file did not have, beside the simplest thing one could do: the last position seen. And
# the share of them inside the stated ellipse of 95 %.


# %%
def inside(result):
    nees = jf.metrics.nees(result.mean[:, :2], result.cov[:, :2, :2], jnp.asarray(truth, ys.dtype))
    return 100 * float(np.mean(np.asarray(nees)[hidden] < jf.metrics.chi2_quantile(0.95, 2)))


last_seen = np.maximum.accumulate(np.where(seen, np.arange(len(ys)), 0))
estimates = {"last position": truth[last_seen], "filter": out.mean[:, :2], "smoother": smoothed.mean[:, :2]}
rows = {}
for name, estimate in estimates.items():
    error = np.asarray(estimate) - truth
    rows[name] = {"RMSE where hidden [m]": np.sqrt(np.mean(np.sum(error[hidden] ** 2, axis=1)))}
rows["filter"]["inside 95 % [%]"] = inside(out)
rows["smoother"]["inside 95 % [%]"] = inside(smoothed)
pd.DataFrame(rows).T.round(1)

# %%
velocity = np.column_stack([reports.sog_mps * np.sin(reports.cog_rad), reports.sog_mps * np.cos(reports.cog_rad)])
error = {name: np.sqrt(np.mean(np.sum((np.asarray(v) - velocity)[20:] ** 2, axis=1)))
         for name, v in {"filter": out.mean[:, 2:], "smoother": smoothed.mean[:, 2:]}.items()}  # fmt: skip
ratio = rows["filter"]["RMSE where hidden [m]"] / rows["last position"]["RMSE where hidden [m]"]
nis = float(np.asarray(out.nis)[seen].mean()) / 2
print(f"velocity RMSE: {', '.join(f'{name} {value:.2f} m/s' for name, value in error.items())}")
print(f"where hidden, the filter's error is {ratio:.2f} of the last position's")
print(f"mean NIS per component {nis:.2f}; inside 95 %: filter {inside(out):.0f} %, smoother {inside(smoothed):.0f} %")

# %% [markdown]
# ## What to take away
#
# * Five lines are the library: `jf.mask_nan`, `jf.intervals`, a model, `jf.filter`, `jf.smooth`.
# * The noise was learnt from the file itself, and then tested on positions that were not in it. Do that with your file.
# * A mean NIS near 1 per component says that the *average* size of the innovations is as stated; peaks in the NIS plot
#   are where the ship maneuvers and a model of straight motion is wrong.
#
# Next: `imm_flight` for targets that maneuver, `tuning` for other ways to tune, `delayed` for data that come late.
