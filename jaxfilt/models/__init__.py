"""State-space models as pytrees."""

from jaxfilt.models import sensors as sensors
from jaxfilt.models.delays import delay_probabilities as delay_probabilities
from jaxfilt.models.delays import success_probabilities as success_probabilities
from jaxfilt.models.delays import with_lags as with_lags
from jaxfilt.models.discretise import van_loan as van_loan
from jaxfilt.models.imu import imu_inputs as imu_inputs
from jaxfilt.models.linear import LinearGaussian as LinearGaussian
from jaxfilt.models.linear import linear_gaussian as linear_gaussian
from jaxfilt.models.motion import constant_acceleration as constant_acceleration
from jaxfilt.models.motion import constant_jerk as constant_jerk
from jaxfilt.models.motion import constant_velocity as constant_velocity
from jaxfilt.models.nonlinear import Nonlinear as Nonlinear
from jaxfilt.models.nonlinear import Sensor as Sensor
from jaxfilt.models.nonlinear import as_nonlinear as as_nonlinear
from jaxfilt.models.nonlinear import nonlinear as nonlinear
from jaxfilt.models.nonlinear import with_sensor as with_sensor
from jaxfilt.models.sincos import sine_cosine as sine_cosine
from jaxfilt.models.singer import maneuver_variance as maneuver_variance
from jaxfilt.models.singer import singer as singer
from jaxfilt.models.turn import coordinated_turn as coordinated_turn
from jaxfilt.models.turn import known_turn as known_turn
