"""Masks for lost measurements."""

import jax
import numpy as np
import pytest

from jaxfilt.simulate import gap_mask, random_gap, random_loss

KEY = jax.random.key(1)


def test_gaps_include_both_ends():
    mask = gap_mask(10, (2, 4), (9, 9))
    assert mask.dtype == bool
    assert np.flatnonzero(~mask).tolist() == [2, 3, 4, 9]


def test_gaps_of_some_components():
    mask = gap_mask(4, (1, 2), m=3, components=[0, 2])
    assert mask.shape == (4, 3)
    assert np.argwhere(~mask).tolist() == [[1, 0], [1, 2], [2, 0], [2, 2]]
    assert not gap_mask(4, (1, 2), m=3)[1:3].any()


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        ((5, (3, 5)), {}, "last < 5"),
        ((5, (3, 2)), {}, "first <= last"),
        ((5, (-1, 2)), {}, "0 <= first"),
        ((0,), {}, "T: expected"),
        ((5, (1, 2)), {"components": [0]}, "without m"),
        ((5, (1, 2)), {"m": 2, "components": [2]}, r"components: expected values in 0\.\.1"),
    ],
)
def test_bad_gaps_are_refused(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        gap_mask(*arguments, **options)


def test_random_loss_has_its_rate_and_is_prefix_stable():
    mask = random_loss(KEY, 20_000, 0.2)
    assert abs(float((~mask).mean()) - 0.2) < 4 * np.sqrt(0.2 * 0.8 / 20_000)
    np.testing.assert_array_equal(random_loss(KEY, 50, 0.2), mask[:50])
    assert random_loss(KEY, 5, 1.0, m=2).shape == (5, 2)
    assert not random_loss(KEY, 5, 1.0, m=2).any()
    assert random_loss(KEY, 5, 0.0).all()
    with pytest.raises(ValueError, match="probability"):
        random_loss(KEY, 5, 1.5)


def test_random_gap_is_one_gap_within_its_ranges():
    masks = np.asarray(
        jax.vmap(lambda key: random_gap(key, 30, length=(2, 5), first=(10, 12)))(jax.random.split(KEY, 500))
    )
    lengths = (~masks).sum(axis=1)
    firsts = masks.argmin(axis=1)
    assert set(lengths) == {2, 3, 4, 5}
    assert set(firsts) == {10, 11, 12}
    lasts = 29 - masks[:, ::-1].argmin(axis=1)
    np.testing.assert_array_equal(lasts - firsts + 1, lengths)
    for bad in ({"length": (0, 2), "first": (0, 1)}, {"length": (1, 2), "first": (0, 30)}):
        with pytest.raises(ValueError, match="expected"):
            random_gap(KEY, 30, **bad)
