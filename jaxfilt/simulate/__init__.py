"""Simulated trajectories, measurements, gaps and delays."""

from jaxfilt.simulate.delays import Received as Received
from jaxfilt.simulate.delays import deliver as deliver
from jaxfilt.simulate.delays import draw_delays as draw_delays
from jaxfilt.simulate.gaps import gap_mask as gap_mask
from jaxfilt.simulate.gaps import random_gap as random_gap
from jaxfilt.simulate.gaps import random_loss as random_loss
from jaxfilt.simulate.imu import Imu as Imu
from jaxfilt.simulate.imu import axis_of_quaternion as axis_of_quaternion
from jaxfilt.simulate.imu import euler_attitude as euler_attitude
from jaxfilt.simulate.imu import imu as imu
from jaxfilt.simulate.trajectories import Simulated as Simulated
from jaxfilt.simulate.trajectories import measure as measure
from jaxfilt.simulate.trajectories import simulate as simulate
