"""State-space models as pytrees."""

from jaxfilt.models.linear import LinearGaussian as LinearGaussian
from jaxfilt.models.linear import linear_gaussian as linear_gaussian
from jaxfilt.models.motion import constant_acceleration as constant_acceleration
from jaxfilt.models.motion import constant_jerk as constant_jerk
from jaxfilt.models.motion import constant_velocity as constant_velocity
