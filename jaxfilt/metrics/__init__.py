"""Errors, statistical consistency, and estimates over independent runs."""

from jaxfilt.chi2 import chi2_quantile as chi2_quantile
from jaxfilt.metrics.attitude import tilt_error as tilt_error
from jaxfilt.metrics.consistency import Consistency as Consistency
from jaxfilt.metrics.consistency import Whiteness as Whiteness
from jaxfilt.metrics.consistency import chi2_region as chi2_region
from jaxfilt.metrics.consistency import consistency as consistency
from jaxfilt.metrics.consistency import nees as nees
from jaxfilt.metrics.consistency import whiteness as whiteness
from jaxfilt.metrics.cramer_rao import Bound as Bound
from jaxfilt.metrics.cramer_rao import posterior_bound as posterior_bound
from jaxfilt.metrics.cramer_rao import start_bound as start_bound
from jaxfilt.metrics.errors import mse as mse
from jaxfilt.metrics.errors import rmse as rmse
from jaxfilt.metrics.errors import squared_error as squared_error
from jaxfilt.metrics.estimates import Estimate as Estimate
from jaxfilt.metrics.estimates import mean as mean
from jaxfilt.metrics.estimates import ratio as ratio
from jaxfilt.metrics.estimates import root_mean as root_mean
from jaxfilt.metrics.performance import PredictorGains as PredictorGains
from jaxfilt.metrics.performance import predictor_gains as predictor_gains
