"""One file per family of filters, one factory per filter."""

from jaxfilt.filters.alpha_beta import alpha_beta as alpha_beta
from jaxfilt.filters.alpha_beta import alpha_beta_gamma as alpha_beta_gamma
from jaxfilt.filters.delayed import adaptive_delayed_kalman as adaptive_delayed_kalman
from jaxfilt.filters.delayed import delayed_kalman as delayed_kalman
from jaxfilt.filters.extended import extended as extended
from jaxfilt.filters.extended import sqrt_extended as sqrt_extended
from jaxfilt.filters.hinf import hinf as hinf
from jaxfilt.filters.hinf import mixed_hinf as mixed_hinf
from jaxfilt.filters.hinf import riccati as riccati
from jaxfilt.filters.hinf import sqrt_mixed_hinf as sqrt_mixed_hinf
from jaxfilt.filters.hinf import theta_max as theta_max
from jaxfilt.filters.imm import imm as imm
from jaxfilt.filters.kalman import kalman as kalman
from jaxfilt.filters.particle import particle as particle
from jaxfilt.filters.sqrt_kalman import sqrt_kalman as sqrt_kalman
from jaxfilt.filters.unscented import cubature as cubature
from jaxfilt.filters.unscented import sqrt_cubature as sqrt_cubature
from jaxfilt.filters.unscented import sqrt_unscented as sqrt_unscented
from jaxfilt.filters.unscented import unscented as unscented
