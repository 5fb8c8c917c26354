"""Each row of the table in the README beside this file: what is measured must not exceed its goal."""

from __future__ import annotations

import numpy as np
import pytest

from tests.robustness.row import F32, F64
from tests.robustness.table import README, ROWS, measured, table

IDS = {F32: "f32", F64: "f64"}


def _cases(full):
    for name, row in ROWS.items():
        for dtype, label in IDS.items():
            marks = [pytest.mark.xdist_group(f"robustness {row.group or name} {label}")]
            if full or dtype in row.slow:
                marks.append(pytest.mark.slow)
            yield pytest.param(name, dtype, full, marks=marks, id=f"{name}-{label}-{'full' if full else 'small'}")


@pytest.mark.parametrize(("name", "dtype", "full"), [*_cases(False), *_cases(True)])
def test_goals_are_reached(name, dtype, full):
    row = ROWS[name]
    figures = row.measure(dtype, full)
    wanted = {key: goal for key, goal in row.goals.items() if full or not goal.slow}
    failures = []
    for key, goal in wanted.items():
        limit = goal.of(dtype)
        if limit is None:
            continue
        reached = figures[key] <= limit  # false for NaN
        if goal.bug and reached and full:
            failures.append(f"{key}: the goal is reached now; remove bug={goal.bug!r}")
        elif not goal.bug and not reached:
            failures.append(f"{key}: {figures[key]:.3g} > {limit:g}")
    assert not failures, "\n".join(failures)
    assert set(figures) <= set(row.goals)


def test_all_thirty_rows_are_there():
    assert list(ROWS) == [f"R{k}" for k in range(1, 31)]


def test_goals_looser_than_proposed_say_which_operation_loses_the_digits():
    for row in ROWS.values():
        for key, goal in row.goals.items():
            assert not goal.why or goal.proposed, f"{row.name}, {key}"
            assert not goal.why or len(goal.why) > 30, f"{row.name}, {key}"


def test_the_published_table_is_of_these_rows_and_within_the_goals():
    found = measured()
    for name, row in ROWS.items():
        for key, goal in row.goals.items():
            for dtype, label in IDS.items():
                limit, value = goal.of(dtype), found[name]["figures"][key][label]
                if value is None:  # of the full form only, and this row was last measured in its small one
                    assert goal.slow or limit is None, f"{name}, {key}, {label}"
                else:
                    assert goal.bug or limit is None or float(value) <= limit, f"{name}, {key}, {label}"
    assert table(found) in README.read_text(encoding="utf-8"), "stale: python -m tests.robustness --write"


def test_the_check_can_fail():
    """A covariance form without the array form's care misses R1 by far: (I - K H) P."""
    from tests.robustness import problems

    eps = np.finfo(np.float64).eps
    p = problems.dyer_mcreynolds(eps**0.4, np.float64)
    S = p.H @ p.P0 @ p.H.T + p.R
    P = (np.eye(3) - p.P0 @ p.H.T @ np.linalg.inv(S) @ p.H) @ p.P0
    assert problems.norm_error(P, problems.exact_posterior(p)) > 1e-6
    assert problems.asymmetric(P) == 1
