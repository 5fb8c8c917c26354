"""The filter with the steady gain."""

from __future__ import annotations

import jaxfilt as jf
from tests.examples import GAP, LINEAR, Example


def _steady_state(p):
    return jf.steady_state(jf.models.linear_gaussian(**p))


EXAMPLES: dict[str, Example] = {"steady_state": Example(jf.steady_state, _steady_state, LINEAR, options=GAP)}
