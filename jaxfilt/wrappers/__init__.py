"""Wrappers: a filter in, a filter out."""

from jaxfilt.wrappers.blend import blend as blend
from jaxfilt.wrappers.inflated import coast_inflated as coast_inflated
from jaxfilt.wrappers.intersection import covariance_intersection as covariance_intersection
from jaxfilt.wrappers.pseudo import hold_last as hold_last
from jaxfilt.wrappers.pseudo import mean_of_recent as mean_of_recent
from jaxfilt.wrappers.pseudo import polynomial_fit as polynomial_fit
from jaxfilt.wrappers.pseudo import sinusoid_fit as sinusoid_fit
