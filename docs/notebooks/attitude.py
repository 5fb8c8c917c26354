# %% [markdown]
# # Attitude from an IMU recording
#
# A gyro knows how a body turns but drifts; an accelerometer knows where down is but feels every push. An attitude
# filter joins them. Here the filters of `jaxfilt` run over recordings of a sensor moved by hand, beside the two that
# everybody uses, Mahony's and Madgwick's. An optical system recorded the true orientation, so the error is known.
#
# Each filter has one knob that matters. It is set on one recording and scored on another.

# %% tags=["parameters"]
learn_from = "trial15_fast_translation"
score_on = ["trial07_fast_rotation", "trial31_stationary_magnet"]
seconds = 45  # of each recording
grid = 16  # values of each knob

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import jaxfilt as jf

# %% [markdown]
# ## A recording
#
# Each begins at rest: its noise is measured there. `jf.imu_inputs` checks what sensors get wrong most often (multiples
# of g, degrees per second, a gap in the gyro) and gives the arguments of `jf.filter`. What is estimated is the vertical
# axis in the body's frame, and so roll and pitch; heading would need a magnetometer.

# %%
dt = 7 / 2000  # s


def read(name):
    file = np.load(f"experiments/data/imu_broad/{name}.npz")
    cut = {
        key: file[key][: round(seconds / dt)].astype(np.float32) for key in ("gyr_radps", "acc_mps2", "quat_enu_wxyz")
    }
    axis = np.asarray(jf.simulate.axis_of_quaternion(cut["quat_enu_wxyz"]))
    scored = file["movement"][: len(axis)] & np.isfinite(axis).all(axis=1)
    rest = slice(0, round(2.0 / dt))
    noise = {"gyro_var": float(cut["gyr_radps"][rest].var(axis=0).mean()),
             "acc_var": float(cut["acc_mps2"][rest].var(axis=0).mean())}  # fmt: skip
    return jf.imu_inputs(cut["gyr_radps"], cut["acc_mps2"]), np.nan_to_num(axis), scored, noise


recordings = {name: read(name) for name in [learn_from, *score_on]}
inputs, axis, scored, noise = recordings[learn_from]
push = np.linalg.norm(inputs["ys"], axis=1) - 9.81
print(f"{len(scored)} samples; |specific force| - g from {push.min():.0f} to {push.max():.0f} m/s²")
print("variances at rest: " + ", ".join(f"{name} {value:.2g}" for name, value in noise.items()))

# %% [markdown]
# ## The filters, each a function of its knob
#
# `jf.attitude_velocity` knows that a hand does not fly away: the velocity stays bounded. `jf.attitude_switched` shuts
# out samples whose length is not that of gravity. The noise of the sensors goes into the Kalman filters only.


# %%
def velocity(knob, noise):
    return jf.attitude_velocity(dt=dt, velocity_var=knob, bias_q=1e-12, **noise)


def switched(knob, noise):
    return jf.attitude_switched(dt=dt, threshold=knob, bias_q=1e-12, **noise)


def complementary(knob, noise):
    return jf.complementary(dt=dt, tau=knob)


def mahony(knob, noise):
    return jf.mahony(dt=dt, proportional=knob)


def madgwick(knob, noise):
    return jf.madgwick(dt=dt, beta=knob)


candidates = {  # function, ends of the knob's range, its value in the literature or the library's default
    "velocity EKF": (velocity, (1e-2, 1e3), 0.1),
    "threshold EKF": (switched, (1e-2, 10.0), 0.3),
    "complementary": (complementary, (0.1, 100.0), 2.0),
    "Mahony": (mahony, (1e-3, 10.0), 0.74),
    "Madgwick": (madgwick, (1e-3, 1.0), 0.12),
}

# %% [markdown]
# ## Turn the knob
#
# A whole grid at once: a filter is a pytree, so `jax.vmap` over the knob filters the recording with all its values.
# Only the axis is kept of each step (`outputs`).


# %%
def keep_axis(state, info):
    return info.mean[:3]


def sweep(make, knobs, recording):
    """Root mean square tilt error [deg] where the body moves, for each knob."""
    inputs, axis, scored, noise = recording

    def one(knob):
        found = jf.filter(make(knob, noise), **inputs, outputs=keep_axis, first_update_only=True)
        square = jf.metrics.tilt_error(found, axis) ** 2
        return jnp.sqrt(jnp.sum(jnp.where(scored, square, 0.0)) / scored.sum())

    return np.rad2deg(jax.jit(jax.vmap(one))(jnp.asarray(knobs)))


figure, ax = plt.subplots(figsize=(9, 4.5), layout="constrained")
chosen = {}
for name, (make, (low, high), default) in candidates.items():
    knobs = np.geomspace(low, high, grid)
    errors = sweep(make, knobs, recordings[learn_from])
    chosen[name] = float(knobs[np.argmin(errors)])
    (line,) = ax.loglog(knobs / default, errors, "o-", ms=4, label=name)
ax.axvline(1.0, color="0.6", lw=1)
ax.set(xlabel="knob / its default", ylabel="tilt error, RMS [deg]", title=f"learnt from: {learn_from}")
ax.legend()
plt.show()

# %% [markdown]
# ## The score on recordings that were not used


# %%
rows = {}
for name, (make, _, default) in candidates.items():
    row = rows[name] = {"knob": chosen[name], "default": default}
    for place in [learn_from, *score_on]:
        errors = sweep(make, np.array([default, chosen[name]]), recordings[place])
        row[f"{place}, default [deg]"], row[f"{place}, learnt [deg]"] = errors
table = pd.DataFrame(rows).T
table.round(2)

# %% [markdown]
# The error over time on the first of them, and what the best filter says about itself.

# %%
place = score_on[0]
inputs, axis, scored, noise = recordings[place]
times = np.arange(len(axis)) * dt
figure, axes = plt.subplots(2, 1, figsize=(10, 6.5), layout="constrained", sharex=True)
for name, (make, _, _) in candidates.items():
    found = jf.filter(make(chosen[name], noise), **inputs, outputs=keep_axis, first_update_only=True)
    tilt = np.rad2deg(jf.metrics.tilt_error(found, axis))
    axes[0].plot(times, np.where(scored, tilt, np.nan), lw=0.8, label=name)
axes[0].set(ylabel="tilt error [deg]", title=place, ylim=(0, None))
axes[0].legend(fontsize=9, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
best = jf.check(jf.filter(velocity(chosen["velocity EKF"], noise), **inputs, first_update_only=True))
jf.plots.estimate(best, component=0, truth=np.where(scored, axis[:, 0], np.nan), times=times,
                  label="velocity EKF", ax=axes[1])  # fmt: skip
axes[1].set_ylabel("vertical axis, first component")
plt.show()

# %%
for place in score_on:
    column = table[f"{place}, learnt [deg]"]
    order = column.sort_values()
    print(f"{place}: " + ", ".join(f"{name} {value:.2f}°" for name, value in order.items()))
    usual, default = min(column["Mahony"], column["Madgwick"]), table[f"{place}, default [deg]"]
    print(f"    {order.index[0]} has {order.iloc[0] / usual:.2f} of the error of the better of Mahony and Madgwick; "
          f"with default knobs the best is {default.idxmin()}, {default.min():.2f}°")  # fmt: skip

# %% [markdown]
# ## What to take away
#
# * A knob that suits one kind of motion need not suit another: compare the default and the learnt columns on recordings
#   that were not learnt from. A filter whose curve is flat is worth more than one with a deep valley.
# * What helps under strong acceleration is a fact about the motion, here that velocity stays bounded. That fact is
#   false for a car.
# * An EKF of the tilt is an ordinary filter: it takes masks and `jf.check`, and the knob could be learnt by gradient.
#
# Next: `experiments/attitude` compares with VQF, which is better than every filter here, with intervals and tuned by
# GA.
