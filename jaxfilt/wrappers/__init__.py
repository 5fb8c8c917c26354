"""Wrappers: a filter in, a filter out."""

from jaxfilt.wrappers.adaptive import detected as detected
from jaxfilt.wrappers.adaptive import gain_floor as gain_floor
from jaxfilt.wrappers.adaptive import p_inflated as p_inflated
from jaxfilt.wrappers.adaptive import q_inflated as q_inflated
from jaxfilt.wrappers.blend import blend as blend
from jaxfilt.wrappers.fuzzy import FuzzyNoise as FuzzyNoise
from jaxfilt.wrappers.fuzzy import fuzzy_noise as fuzzy_noise
from jaxfilt.wrappers.fuzzy import fuzzy_noise_parameters as fuzzy_noise_parameters
from jaxfilt.wrappers.fuzzy import fuzzy_scaled as fuzzy_scaled
from jaxfilt.wrappers.gate import gated as gated
from jaxfilt.wrappers.gate import nearest_neighbor as nearest_neighbor
from jaxfilt.wrappers.gate import scan_inputs as scan_inputs
from jaxfilt.wrappers.inflated import coast_inflated as coast_inflated
from jaxfilt.wrappers.intersection import covariance_intersection as covariance_intersection
from jaxfilt.wrappers.noise import covariance_matching as covariance_matching
from jaxfilt.wrappers.noise import fading_memory as fading_memory
from jaxfilt.wrappers.noise import sage_husa as sage_husa
from jaxfilt.wrappers.pseudo import hold_last as hold_last
from jaxfilt.wrappers.pseudo import mean_of_recent as mean_of_recent
from jaxfilt.wrappers.pseudo import polynomial_fit as polynomial_fit
from jaxfilt.wrappers.pseudo import sinusoid_fit as sinusoid_fit
from jaxfilt.wrappers.residual import nis_q as nis_q
from jaxfilt.wrappers.residual import residual_r as residual_r
from jaxfilt.wrappers.usable import usable_where as usable_where
from jaxfilt.wrappers.variable_dimension import variable_dimension as variable_dimension
