"""One file per family of filters, one factory per filter."""

from jaxfilt.filters.alpha_beta import alpha_beta as alpha_beta
from jaxfilt.filters.alpha_beta import alpha_beta_gamma as alpha_beta_gamma
from jaxfilt.filters.kalman import kalman as kalman
from jaxfilt.filters.sqrt_kalman import sqrt_kalman as sqrt_kalman
