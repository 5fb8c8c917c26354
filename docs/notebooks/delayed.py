# %% [markdown]
# # Delayed and lost measurements
#
# A vehicle sends its position eighteen times a second through a mobile network. Most messages arrive before the next
# one is sent, some are late, and now and then nothing comes for seconds. Where is the vehicle *now*?
#
# The answer depends on what the receiver knows: nothing (only what is in its buffer), whether something has arrived, or
# when it was sent. `jaxfilt` has a filter for each. The delays are recorded ones of a weak 5G network; the positions
# are the vehicle's own, with 1 m of noise added, so that the truth is known.

# %% tags=["parameters"]
recordings = ["rural_weak_10s_stalls", "strong_to_weak"]
max_delay = 4  # samples; what is later counts as lost

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import jaxfilt as jf

# %% [markdown]
# ## The recordings
#
# A sample is the instant at which a message is sent. A message that is under way when the next one is sent arrives one
# sample late, and so on. `jf.simulate.deliver` plays the channel: which message is the newest at each step (`ys`,
# `mask`), how old it is (`lag`), and all that arrive (`packets`, `arrived`).

# %%
sigma = 1.0  # m
rng = np.random.default_rng(5)


def read(name):
    rows = pd.read_csv(f"experiments/data/network_cicv5g/{name}.csv")
    late = np.searchsorted(rows.t_send_s, rows.t_recv_s) - np.arange(len(rows))
    delays = np.minimum(late, max_delay + 1).astype(np.int32)
    truth = rows[["x_east_m", "y_north_m"]].to_numpy()
    sent = jnp.asarray(truth + sigma * rng.standard_normal(truth.shape))
    dt = jf.intervals(rows.t_send_s.to_numpy(), first=0.055)
    return truth, sent, dt, delays


data = {name: read(name) for name in recordings}
classes = ["on time", *(f"{lag} late" for lag in range(1, max_delay + 1)), "lost"]
shares = {name: np.bincount(delays, minlength=max_delay + 2) / len(delays) for name, (*_, delays) in data.items()}
pd.DataFrame(shares, index=classes).round(3)

# %% [markdown]
# ## Filters for what one may know
#
# All share one motion model. The probabilities of the delays are counted in the first recording, and one is added to
# each count: a probability of exactly 0 says "never".
#
# * `jf.kalman` of `jf.models.with_lags` knows the time stamps: the state holds the last positions too, and a late
#   packet is a measurement of one of them. It is exact.
# * `jf.kalman` with a mask knows whether something has arrived, and takes it as of now.
# * `jf.coast_inflated` and `jf.hold_last` are wrappers: more noise while nothing comes, or the last value fed again.
# * `jf.delayed_kalman` knows neither. What does not arrive is 0 in its data, and it reckons with the probabilities.
#   `jf.adaptive_delayed_kalman` also trusts less while innovations are larger than expected.

# %%
counts = np.bincount(data[recordings[0]][3], minlength=max_delay + 2) + 1
probabilities = jnp.asarray(counts / counts.sum())
motion = jf.models.constant_velocity(
    dt=0.055, q=1.0, r=sigma**2, m0=np.zeros(4), P0=np.diag([sigma**2, sigma**2, 25.0, 25.0])
)
coasting = jf.kalman(motion)
filters = {
    "time stamps": (jf.kalman(jf.models.with_lags(motion, max_delay)), "stamps"),
    "arrivals": (coasting, "arrivals"),
    "arrivals, coast_inflated": (jf.coast_inflated(coasting, 10.0), "arrivals"),
    "arrivals, hold_last": (jf.hold_last(coasting), "arrivals"),
    "nothing, delayed_kalman": (jf.delayed_kalman(motion, probabilities, second_moment="posterior"), "zeros"),
    "nothing, adaptive": (jf.adaptive_delayed_kalman(motion, probabilities, second_moment="posterior"), "zeros"),
}


def given(sent, delays, what):
    """The arguments of jf.filter, by what the receiver knows."""
    received = jf.simulate.deliver(sent, delays, max_delay)
    if what == "stamps":
        return {"ys": received.packets, "mask": received.arrived}
    if what == "arrivals":
        return {"ys": received.ys, "mask": received.mask}
    return {"ys": received.ys}


# %%
out, error, cut_off = {}, {}, {}
for name, (truth, sent, dt, delays) in data.items():
    arrived = np.asarray(jf.simulate.deliver(sent, delays, max_delay).mask).all(axis=1)
    newest = np.maximum.accumulate(np.where(arrived, np.arange(len(truth)), 0))
    held = np.asarray(jf.simulate.deliver(sent, delays, max_delay).ys)[newest]
    cut_off[name] = np.arange(len(truth)) - newest > max_delay
    error[name, "last value received"] = np.linalg.norm(held - truth, axis=1)
    for label, (filt, what) in filters.items():
        found = jf.check(jf.filter(filt, dt=dt, first_update_only=True, **given(sent, delays, what)))
        out[name, label] = found
        error[name, label] = np.linalg.norm(np.asarray(found.mean)[:, :2] - truth, axis=1)

# %% [markdown]
# ## One stall
#
# The error around the longest stall of the first recording, on a logarithmic scale.

# %%
truth, _, dt, _ = data[recordings[0]]
times = np.cumsum(np.asarray(dt, float))
off = cut_off[recordings[0]]
length = np.zeros(len(off), int)
for k in range(1, len(off)):
    length[k] = length[k - 1] + 1 if off[k] else 0
last = int(np.argmax(length))
part = slice(max(last - length[last] - 60, 0), last + 80)
figure, ax = plt.subplots(figsize=(10, 4.5), layout="constrained")
for label in ("last value received", "time stamps", "arrivals", "arrivals, hold_last", "nothing, delayed_kalman"):
    ax.semilogy(times[part], np.maximum(error[recordings[0], label][part], 1e-2), label=label)
ax.axvspan(times[last - length[last]], times[last], color="0.9", label="nothing arrives")
ax.set(xlabel="time [s]", ylabel="error of the position now [m]", title=f"a stall of {length[last] * 0.055:.1f} s")
ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
plt.show()

# %% [markdown]
# ## The score
#
# RMSE of the position now, over each recording without its first 5 s, and over the samples where something had arrived
# within the last few.

# %%
rows = {}
for (name, label), e in error.items():
    whole = np.arange(len(e)) * 0.055 > 5.0
    connected = whole & ~cut_off[name]
    row = rows.setdefault(label, {})
    row[name, "all"] = np.sqrt(np.mean(e[whole] ** 2))
    row[name, "connected"] = np.sqrt(np.mean(e[connected] ** 2))
table = pd.DataFrame(rows).T
table.columns = pd.MultiIndex.from_tuples(table.columns, names=["recording", "RMSE [m]"])
table.round(2)

# %%
for name in recordings:
    column = table[name, "all"]
    told = column[["time stamps", "arrivals", "last value received"]]
    blind = column[["nothing, delayed_kalman", "nothing, adaptive"]].min()
    print(f"{name}: time stamps {told['time stamps']:.2f} m, arrivals only {told['arrivals']:.2f} m, "
          f"last value {told['last value received']:.2f} m; the better filter told nothing {blind:.2f} m")  # fmt: skip
    worse = column["arrivals, hold_last"] / column["arrivals"]
    print(f"    feeding the last value back costs a factor {worse:.2f} against coasting")

# %% [markdown]
# ## What to take away
#
# * If the packets have time stamps, use them: `jf.models.with_lags` turns late packets into ordinary measurements, and
#   any linear filter of it is exact.
# * If not, a mask of arrivals is nearly always known, and it is worth more than any model of the channel.
# * `jf.delayed_kalman` is for data where an empty sample cannot be told from a zero. Its optimality is that of a
#   channel whose packets are delayed independently; a stall of seconds is not such a channel.
#
# Next: `experiments/delayed_measurements` learns the channel from the data, and reproduces a paper's table with it.
