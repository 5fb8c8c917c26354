# %% [markdown]
# # Robust: H-infinity and fuzzy filters
#
# A Kalman filter is the best on average if Q and R are right. Two other promises are on offer: an H-infinity filter
# bounds the *worst* case, whatever the noise does, and a fuzzy filter changes R and Q while it runs, by rules about the
# size of the innovations. This notebook asks what each buys, and what it costs.

# %% tags=["parameters"]
runs = 16  # series for tuning, with bursts of noise
held_out = 200  # series for the score
steps = 40  # of gradient descent
goals = ["likelihood", "error"]  # what is tuned for

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from jax.tree_util import Partial

import jaxfilt as jf

# %% [markdown]
# ## The worst case
#
# Position and velocity, position measured each second. `jf.theta_max` is the largest bound that a filter can keep.
# Towards it the mixed Kalman/H-infinity filter gives up some of the mean square for the worst case: the largest
# amplification of any noise sequence into errors. Both are computed exactly for the stationary predictor, by
# `jf.metrics.predictor_gains`.

# %%
F, H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
Q, R = 0.1 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]), np.array([[25.0]])
model = jf.models.linear_gaussian(F, H, Q, R, np.zeros(2), np.diag([25.0, 4.0]))
limit = min(jf.theta_max(model), jf.theta_max(model, steps=200))  # in the long run, and on the way there


def stationary_gain(P, theta):
    inflated = jnp.linalg.inv(jnp.linalg.inv(P) - theta**2 * jnp.eye(2))
    return F @ inflated @ H.T / (H @ inflated @ H.T + R)


@jax.jit
@jax.vmap
def performance(share, factor):
    """Mean square and worst case of a predictor with this share of theta_max, told this factor on Q."""
    theta = share * limit
    P = jf.riccati(model._replace(Q=factor * model.Q), theta)
    return jf.metrics.predictor_gains(F, H, Q, R, stationary_gain(P, theta))


# The plain alternative to theta is a Kalman filter that is told more process noise.
shares, factors = jnp.array([0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98]), jnp.geomspace(1.0, 30.0, 7)
hinf, inflated = performance(shares, jnp.ones(7)), performance(jnp.zeros(7), factors)
figure, ax = plt.subplots(figsize=(7, 4.5), layout="constrained")
ax.plot(hinf.mean_square, np.sqrt(hinf.worst_case), "o-", label="mixed H-infinity, theta / theta_max")
for share, x, y in zip(shares, hinf.mean_square, np.sqrt(hinf.worst_case), strict=True):
    ax.annotate(f"{share:.2g}", (x, y), textcoords="offset points", xytext=(5, 5), fontsize=8)
ax.plot(inflated.mean_square, np.sqrt(inflated.worst_case), "s--", ms=4, label="Kalman with Q times 1 to 30")
ax.set(xlabel="mean square error of the prediction", ylabel="worst-case gain", title="what the worst case costs")
ax.legend()
plt.show()

# %% [markdown]
# As a filter it is used like any other (from a prior that the bound can hold for, or it says so). A missed sample is a
# step without bound, BOUND in the status would say that the guarantee was lost.

# %%
_, ys = jf.simulate.simulate(model, 200, jax.random.key(0))
for share in (0.0, 0.9):
    out = jf.check(jf.filter(jf.mixed_hinf(model, share * limit), ys))
    print(f"theta = {share} theta_max: smallest margin {float(out.extra['margin'].min()):.3f} (feasible above 0)")

# %% [markdown]
# ## Bursts of noise
#
# Now the sensor's variance is 25 times larger in windows that the filter is not told of. `u` carries the factor for the
# simulation, and for one filter that is told, as the bound of what can be had.


# %%
T, burst, universe = 150, 25.0, 40.0  # samples, factor on R, m


def scaled_noise(R, u, dt):
    return u * R


noisy = model._replace(R=Partial(scaled_noise, model.R))


def draw(key):
    """One run: quiet and noisy windows of 20 to 60 samples in turn."""
    window_key, run_key = jax.random.split(key)
    ends = jnp.cumsum(jax.random.randint(window_key, (T // 20,), 20, 61))
    window = jnp.sum(jnp.arange(T)[:, None] >= ends[None, :], axis=1)
    u = jnp.where(window % 2 == 1, burst, 1.0)
    truth, ys = jf.simulate.simulate(noisy, T, run_key, u=u)
    return {"truth": truth, "ys": ys, "u": u}


training = jax.vmap(draw)(jax.random.split(jax.random.key(1), runs))
fresh = jax.vmap(draw)(jax.random.split(jax.random.key(2), held_out))

# %% [markdown]
# ## Filters that adapt, and their knobs
#
# * `jf.fuzzy_scaled`: a Mamdani system of the innovation's size scales R; its corners and the exponent are knobs. With
#   the published exponents a large innovation makes the filter trust the sensor *more*, right for a maneuver, wrong
#   here.
# * `jf.fuzzy_noise`: smooth sets (Takagi-Sugeno), recent innovations instead of the last one, levels of R as knobs.
# * Both may change R only (`scale="r"`): it is the sensor that is noisy, not the target.
# * For fairness, a Kalman filter whose constant R and Q are tuned in the same way.


# %%
def constant(p):
    return jf.kalman(model._replace(Q=p["q"] * model.Q, R=p["r"] * model.R))


def mamdani(p):
    system = jf.fuzzy.mamdani(universe, corners=jf.fuzzy.partition(universe, logits=p["logits"]))
    options = {"r_exponent": p["r_exponent"], "reference": p["reference"]}
    return jf.fuzzy_scaled(jf.kalman(model), system, scale="r", **options)


def takagi_sugeno(p):
    return jf.fuzzy_noise(jf.kalman(model), p, scale="r")


start = jf.fuzzy_noise_parameters([universe], alpha=np.ones(4))
real = jf.tune.real
spaces = {
    "constant R, Q": (constant, {"r": jf.tune.positive(1.0), "q": jf.tune.positive(1.0)}),
    "fuzzy_scaled": (mamdani, {
        "logits": real(np.zeros(7), -4.0, 4.0), "reference": jf.tune.positive(50.0, 1.0, 1000.0),
        "r_exponent": real(-1.0, -3.0, 3.0),
    }),
    "fuzzy_noise": (takagi_sugeno, jf.FuzzyNoise(
        jf.tune.unit(start.forgetting), jf.tune.positive(start.gaps), jf.tune.positive(start.widths),
        real(start.log_alpha_r, -5.0, 5.0), start.log_alpha_q,
    )),
}  # fmt: skip

# %% [markdown]
# Two losses: the innovation likelihood, which needs no truth and so could be had on recorded data, and the error
# itself, which a simulation knows.


# %%
def likelihood(make, params, data):
    return jf.tune.innovation_nll(make(params), data["ys"], warmup=10)


def error(make, params, data):
    return jf.tune.rmse(make(params), data["ys"], data["truth"], components=(0,))


losses = {"likelihood": likelihood, "error": error}
tuned = {}
for name, (make, space) in spaces.items():
    for goal in goals:
        objective = Partial(losses[goal], Partial(make))
        found = tuned[name, goal] = jf.tune.gradient(objective, space, training, key=jax.random.key(0), steps=steps)
        print(f"{name}, {goal}: {found.loss:.3f}, {jf.tune.size(space)} knobs, {found.wall_time:.1f} s")

# %% [markdown]
# ## The sets before and after

# %%
figure, axes = plt.subplots(1, 2, figsize=(12, 4), layout="constrained")
before = jf.fuzzy.partition(universe)
after = jf.fuzzy.partition(universe, logits=tuned["fuzzy_scaled", "error"].params["logits"])
jf.plots.memberships(before, after, universe=universe, unit="m", ax=axes[0])
axes[0].set(xlabel="size of the innovation in fuzzy_scaled [m]")
x = jnp.linspace(0.0, universe, 400)
shown = {"before": start, **{f"tuned for {goal}": tuned["fuzzy_noise", goal].params for goal in goals}}
for label, p in shown.items():
    levels = jf.fuzzy.stick_breaking(x, jnp.cumsum(p.gaps, -1)[0], p.widths[0])
    factor = jnp.exp(-levels @ p.log_alpha_r)
    axes[1].plot(x, factor, "--" if label == "before" else "-", label=label)
axes[1].axhline(burst, color="0.6", lw=1, label="true factor in a burst")
axes[1].set(xlabel="recent size of the innovations [m]", ylabel="factor on R", yscale="log", title="fuzzy_noise")
axes[1].legend()
plt.show()

# %% [markdown]
# ## The score
#
# Position RMSE on fresh runs, in bursts and between them, and NIS, which is 1 for an honest filter.


# %%
def keep(state, info):
    return info.mean[0], info.nis


@jax.jit
def filtered(filt, data):
    return jax.vmap(lambda y, u: jf.filter(filt, y, u=u, outputs=keep))(data["ys"], data["u"])


filters = {
    "Kalman, R of quiet times": jf.kalman(model),
    "mixed H-infinity, 0.9 theta_max": jf.mixed_hinf(model, 0.9 * limit),
    "fuzzy_scaled, as published": mamdani(jf.tune.initial(spaces["fuzzy_scaled"][1])),
    **{f"{name}, {goal}": spaces[name][0](result.params) for (name, goal), result in tuned.items()},
    "Kalman, told the true R": jf.kalman(noisy),
}
truth, loud = np.asarray(fresh["truth"])[:, :, 0], np.asarray(fresh["u"]) > 1
rows, squares = {}, {}
for name, filt in filters.items():
    mean, nis = filtered(filt, fresh)
    square = (np.asarray(mean) - truth) ** 2
    squares[name] = square.mean(axis=1)
    rows[name] = {"RMSE [m]": np.sqrt(square.mean()), "quiet": np.sqrt(square[~loud].mean()),
                  "in bursts": np.sqrt(square[loud].mean()), "mean NIS": float(nis.mean())}  # fmt: skip
table = pd.DataFrame(rows).T
table.round(2)

# %%
reference = "constant R, Q, error"
for name in filters:
    if name != reference:
        ratio = jf.metrics.ratio(squares[name], squares[reference], root=True)
        print(f"RMSE of {name} over {reference}: {ratio.value:.3f} ± {ratio.standard_error:.3f}")
worst, square = np.sqrt(hinf.worst_case[4] / hinf.worst_case[0]), hinf.mean_square[4] / hinf.mean_square[0]
print(f"0.9 theta_max against the Kalman filter: worst-case gain {worst:.2f}, mean square {square:.2f}")
same = float(jnp.interp(hinf.mean_square[4], inflated.mean_square, jnp.sqrt(inflated.worst_case / hinf.worst_case[0])))
print(f"a Kalman filter with more Q at the same mean square: worst-case gain {same:.2f}")

# %% [markdown]
# ## What to take away
#
# * The worst-case bound is real, and so is its price in the mean square. The plain alternative, a Kalman filter that is
#   told more process noise, pays more for less.
# * The worst case of the theory is no burst of sensor noise: against those the H-infinity filter trusts the newest
#   measurement more, where it should trust it less.
# * A fuzzy filter as published harms here. Tuned, it finds by itself in which direction R should move; whether that
#   beats a constant R tuned for the same goal is what the table says. The filter that is told the true R shows what
#   could be reached at most.
# * Tune for what you want. A better likelihood is no smaller error: NIS and RMSE tell the goals apart.
#
# Next: `experiments/balloon` compares these with other ways to learn the noise, on recorded radiosonde ascents too.
