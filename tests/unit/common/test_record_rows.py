"""Rows of records of arrays: taken and replaced in every array, nested ones too; the rest stays."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import rows_of, with_rows


@dataclass(frozen=True)
class Inner:
    shift_mm: np.ndarray


@dataclass(frozen=True)
class Outer:
    name: str
    t_ns: np.ndarray
    inner: Inner


def outer(first):
    t = np.arange(first, first + 4)
    return Outer("brick", t, Inner(np.stack([t, t * 10], axis=1)))


def test_some_rows_are_taken_of_every_array():
    for rows in (np.array([2, 0]), np.array([True, False, True, False]), slice(1, 3)):
        some = rows_of(outer(5), rows)
        assert some.name == "brick"
        np.testing.assert_array_equal(some.t_ns, np.arange(5, 9)[rows])
        np.testing.assert_array_equal(some.inner.shift_mm[:, 1], 10 * some.t_ns)


def test_rows_are_replaced_and_the_record_of_before_stays():
    before = outer(0)
    after = with_rows(before, np.array([3, 1]), rows_of(outer(100), np.array([0, 1])))
    np.testing.assert_array_equal(after.t_ns, [0, 101, 2, 100])
    np.testing.assert_array_equal(after.inner.shift_mm[:, 1], [0, 1010, 20, 1000])
    np.testing.assert_array_equal(before.t_ns, np.arange(4))
