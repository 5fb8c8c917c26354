"""One file per family of filters, one factory per filter."""

from jaxfilt.filters.kalman import kalman as kalman
from jaxfilt.filters.sqrt_kalman import sqrt_kalman as sqrt_kalman
