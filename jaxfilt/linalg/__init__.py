"""Small dense matrices: guarded Cholesky, triangular solves, triangularisation."""

from jaxfilt.linalg.dense import chol as chol
from jaxfilt.linalg.dense import mirror as mirror
from jaxfilt.linalg.dense import scale_cov as scale_cov
from jaxfilt.linalg.dense import scale_factor as scale_factor
from jaxfilt.linalg.dense import solve_chol as solve_chol
from jaxfilt.linalg.dense import solve_lower as solve_lower
from jaxfilt.linalg.dense import solve_lower_t as solve_lower_t
from jaxfilt.linalg.dense import sym as sym
from jaxfilt.linalg.dense import tria as tria
from jaxfilt.linalg.entries import is_zero as is_zero
from jaxfilt.linalg.rotations import rotation as rotation
from jaxfilt.linalg.rotations import skew as skew
from jaxfilt.linalg.scalarize import instead as instead
