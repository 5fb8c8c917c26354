# %% [markdown]
# # A maneuvering target: IMM on a recorded flight
#
# A glider flies straight for a while and then circles in a thermal, one turn in some twenty seconds. A filter that
# believes in straight flight (CV) loses it in the circle, a filter that believes in turns (CT) is nervous on the
# straight parts. The interacting multiple model (IMM) filter runs both and weighs them by how well each predicts.
#
# The flights are recordings of GNSS flight recorders, one fix per second. The noise is learnt on one flight and scored
# on another, where fixes are hidden in gaps: what the filters say there is compared with what was recorded.

# %% tags=["parameters"]
fixes = 1100  # of the scored flight
pieces = 8  # of 300 s, of the flight that is learnt from
steps = 80  # of gradient descent
gap = 12  # s, hidden in each minute

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from jax.tree_util import Partial

import jaxfilt as jf


def read(name):
    flight = pd.read_csv(f"experiments/data/glider_igc/{name}.csv")
    return flight.t_s.to_numpy(float), flight[["east_m", "north_m"]].to_numpy()


# %% [markdown]
# ## Two filters from one vocabulary
#
# An IMM takes any filters. Their states may differ: `index` says where each one's components stand in the union,
# here east, north, their rates, and the turn rate that CV does not have.

# %%
prior_variance = np.array([25.0, 25.0, 900.0, 900.0, 0.1])


def cv(p):
    prior = {"m0": np.zeros(4), "P0": np.diag(prior_variance[:4])}
    return jf.kalman(jf.models.constant_velocity(dt=1.0, q=p["q"], r=p["r"], **prior))


def ct(p):
    noise = {"q": p["q_turn"], "q_omega": p["q_omega"], "r": p["r"]}
    return jf.extended(jf.models.coordinated_turn(dt=1.0, m0=np.zeros(5), P0=np.diag(prior_variance), **noise))


def imm(p):
    stay = p["stay"]
    transition = jnp.array([[stay, 1 - stay], [1 - stay, stay]])
    return jf.imm([cv(p), ct(p)], transition, index=[(0, 1, 2, 3), (0, 1, 2, 3, 4)])


noise = {"q": jf.tune.positive(1.0), "r": jf.tune.positive(4.0)}
turning = {
    "q_turn": jf.tune.positive(1.0),
    "q_omega": jf.tune.positive(1e-3),
    "stay": jf.tune.interval(0.95, 0.5, 0.9999),
}
candidates = {"CV": (cv, noise), "IMM": (imm, noise | turning)}

# %% [markdown]
# ## Learn the noise on one flight
#
# The loss is the innovation likelihood over pieces of five minutes, each counted from its first fix. The same optimizer
# and the same number of steps for both.

# %%
_, track = read("soaring_1s")
ys = track[: 300 * pieces].reshape(pieces, 300, 2)
data = {"ys": jnp.asarray(ys - ys[:, :1])}


def loss(make, params, data):
    return jf.tune.innovation_nll(make(params), data["ys"], warmup=10, first_update_only=True)


filters = {}
for name, (make, space) in candidates.items():
    objective = Partial(loss, Partial(make))  # a loss is a pytree: bind what it needs, functions as Partials too
    found = jf.tune.gradient(objective, space, data, key=jax.random.key(0), steps=steps)
    filters[name] = make(found.params)
    learnt = ", ".join(f"{key} {float(value):.3g}" for key, value in found.params.items())
    print(f"{name}: {found.loss:.2f} nats per fix in {found.wall_time:.0f} s; {learnt}")

# %% [markdown]
# ## Hide fixes of another flight
#
# Of the second flight we take what comes before a real dropout of 143 s. In each minute the last seconds are hidden.
# When did it circle? The recorded course says so, five fixes to either side taken together.

# %%
times, track = read("soaring_gap_1s")
dropout = int(np.argmax(np.diff(times))) + 1
times, track = times[dropout - fixes : dropout], track[dropout - fixes : dropout]
course = np.unwrap(np.arctan2(*np.gradient(track, axis=0).T[::-1]))
rate = np.abs(np.convolve(np.gradient(course), np.ones(11) / 11, "same"))
circling = np.rad2deg(rate) > 6.0
origin = track[0]
truth = jnp.asarray(track - origin)
seen = np.arange(len(times)) % 60 < 60 - gap
options = {"mask": jnp.asarray(seen), "dt": jf.intervals(times, first=1.0), "first_update_only": True}
out = {name: jf.check(jf.filter(filt, truth, **options)) for name, filt in filters.items()}
probabilities = out["IMM"].extra["mode_probabilities"]

figure, axes = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
begin = int(np.argmax(np.convolve(circling, np.ones(200), "valid")))  # the 200 s with most circling
part = slice(begin, begin + 200)
for ax, (name, result) in zip(axes, out.items(), strict=True):
    first = jax.tree.map(lambda x: x[part], result)
    jf.plots.track(first, truth=truth[part], mask=seen[part], label=name, ax=ax)
    ax.set_title(f"{name}, 200 s")
plt.show()

# %% [markdown]
# Which model is believed when? The strip above shows what the course says.

# %%
ax = jf.plots.mode_probabilities(probabilities, names=("CV", "CT"), truth=circling.astype(int), times=times)
plt.show()

# %% [markdown]
# ## The score
#
# RMSE over the hidden fixes, in gaps where the glider circled and in those where it did not, beside holding the last
# fix. NEES is that of the last hidden fix of each gap, per component: 1 is honest, far above is overconfident.

# %%
last_seen = np.maximum.accumulate(np.where(seen, np.arange(len(times)), 0))
estimates = {"last fix": truth[last_seen], **{name: result.mean[:, :2] for name, result in out.items()}}
parts = {"circling": circling & ~seen, "straight": ~circling & ~seen}
ends = np.flatnonzero(~seen[:-1] & seen[1:])
rows = {}
for name, estimate in estimates.items():
    square = np.asarray(jf.metrics.squared_error(estimate, truth))
    rows[name] = {f"{part}, RMSE [m]": np.sqrt(square[where].mean()) for part, where in parts.items()}
    if name in out:
        nees = jf.metrics.nees(out[name].mean[ends, :2], out[name].cov[ends, :2, :2], truth[ends])
        rows[name]["NEES / 2 at the end of gaps"] = float(nees.mean()) / 2
table = pd.DataFrame(rows).T
counted = ", ".join(f"{where.sum()} {part}" for part, where in parts.items())
print(f"{len(ends)} gaps of {gap} s; fixes hidden: {counted}")
table.round(1)

# %%
agree = np.mean((np.asarray(probabilities)[:, 1] > 0.5) == circling)
for part in parts:
    rmse = table[f"{part}, RMSE [m]"]
    ratios = rmse["IMM"] / rmse[["CV", "last fix"]]
    print(f"{part}: IMM has {ratios['CV']:.2f} of CV's error and {ratios['last fix']:.2f} of the last fix's")
print(f"CT is the likelier mode in {100 * np.mean(np.asarray(probabilities)[:, 1] > 0.5):.0f} % of all fixes; "
      f"this agrees with the course in {100 * agree:.0f} %")  # fmt: skip

# %% [markdown]
# ## What to take away
#
# * An IMM is one call over ordinary filters, and it is a filter again: the same `jf.filter`, `jf.check`, tuning and
#   masks.
# * Compare with something trivial. In a circle the last fix is never far away, and a filter that flies on along the
#   tangent gains little over it.
# * Look at the straight parts by themselves: they show what readiness to turn costs where nobody turns. Here it is
#   little.
# * The mode probabilities say which model predicts better, not what the pilot did; the strip of the course above them
#   is computed from later fixes too.
#
# Next: `experiments/circling` has intervals for these ratios over 520 gaps, and models that drift with the wind.
