"""How a small example of a filter looks, and what several of them share. One module for each family beside this one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import jaxfilt as jf

T = 12


class Example(NamedTuple):
    """How to build a small filter of this kind, and the series it is run on."""

    factory: Callable  # the public factory
    make: Callable[[Any], jf.Filter]  # params (a pytree of float arrays) -> filter
    params: dict[str, Any]  # float64 values; cast to the dtype under test
    m: int = 2
    options: dict[str, Any] = {}  # further arguments of jf.filter  # noqa: RUF012
    exempt: dict[str, str] = {}  # property -> reason  # noqa: RUF012
    twin: bool = False  # shares its code with another example: its dearest properties are slow tests


LINEAR = {
    "F": np.array([[0.9, 0.3, 0.1], [-0.2, 0.8, 0.4], [0.0, -0.3, 0.7]]),
    "H": np.array([[1.0, 0.2, 0.0], [0.3, -0.5, 1.0]]),
    "Q": np.array([[0.5, 0.1, 0.0], [0.1, 0.3, -0.05], [0.0, -0.05, 0.2]]),
    "R": np.array([[1.0, 0.3], [0.3, 2.0]]),
    "m0": np.array([0.5, -1.0, 0.2]),
    "P0": np.array([[2.0, 0.3, 0.1], [0.3, 1.5, -0.2], [0.1, -0.2, 1.0]]),
}
# One component missing at step 8, both at 9 and 10.
GAP = {"mask": np.array([[True, True]] * 8 + [[True, False], [False, False], [False, False], [True, True]])}
