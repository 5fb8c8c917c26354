"""Tuning: constrained parameters, losses on batches of series, and tuners that all return the same result.

    space = {"q": jf.tune.positive(0.001), "r": jf.tune.positive(25.0)}

    def loss(params, ys):
        return jf.tune.innovation_nll(make_filter(params), ys)

    found = jf.tune.gradient(loss, space, ys, key=jax.random.key(0))
    again = jf.tune.genetic(loss, space, ys, key=jax.random.key(0))
    found.params, found.loss, again.best_at(10.0)

A loss closes over nothing that is traced: what it needs goes into ``space`` (plain values are frozen) or into ``data``.
"""

from jaxfilt.tune.evolution import genetic as genetic
from jaxfilt.tune.evolution import nsga2 as nsga2
from jaxfilt.tune.gradient import gradient as gradient
from jaxfilt.tune.held_out import masked_nll as masked_nll
from jaxfilt.tune.held_out import random_gap as random_gap
from jaxfilt.tune.losses import consistency as consistency
from jaxfilt.tune.losses import innovation_nll as innovation_nll
from jaxfilt.tune.losses import prediction_mse as prediction_mse
from jaxfilt.tune.losses import rmse as rmse
from jaxfilt.tune.params import Spec as Spec
from jaxfilt.tune.params import bounds as bounds
from jaxfilt.tune.params import constrain as constrain
from jaxfilt.tune.params import covariance as covariance
from jaxfilt.tune.params import frozen as frozen
from jaxfilt.tune.params import initial as initial
from jaxfilt.tune.params import interval as interval
from jaxfilt.tune.params import ordered as ordered
from jaxfilt.tune.params import positive as positive
from jaxfilt.tune.params import real as real
from jaxfilt.tune.params import sample as sample
from jaxfilt.tune.params import size as size
from jaxfilt.tune.params import to_vector as to_vector
from jaxfilt.tune.params import unconstrain as unconstrain
from jaxfilt.tune.params import unit as unit
from jaxfilt.tune.result import Front as Front
from jaxfilt.tune.result import History as History
from jaxfilt.tune.result import TuneResult as TuneResult
