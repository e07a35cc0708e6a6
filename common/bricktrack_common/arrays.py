"""Array aliases, the one check of shape at the door of public functions, and rows of records of arrays."""

from dataclasses import fields, is_dataclass, replace
from types import EllipsisType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bricktrack_common.errors import ShapeError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Record = TypeVar("Record", bound="DataclassInstance")
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def as_float_array(name: str, values: ArrayLike, shape: tuple[int | EllipsisType | None, ...]) -> FloatArray:
    """Return ``values`` as float64 with the trailing dimensions given by ``shape``.

    Parameters
    ----------
    name : str
        How the message calls the array.
    values : array_like
        What the caller gave; NaN is allowed, it means "not measured".
    shape : tuple
        Required dimensions, `None` where any length will do. An `...` (Ellipsis) in front lets
        any number of leading dimensions pass.

    Raises
    ------
    ShapeError
        If the shape differs; the message prints both.

    Examples
    --------
    >>> as_float_array("points", [[1, 2, 3]], (..., 3)).shape
    (1, 3)
    >>> as_float_array("points", [1, 2], (..., 3))
    Traceback (most recent call last):
    bricktrack_common.errors.ShapeError: points has shape (2,); expected (..., 3)
    """
    array: NDArray[Any] = np.asarray(values, dtype=np.float64)
    wanted = shape
    actual = array.shape
    if wanted and wanted[0] is ...:
        wanted = wanted[1:]
        actual = actual[len(actual) - len(wanted) :] if len(actual) >= len(wanted) else actual
    fits = len(actual) == len(wanted) and all(
        w is None or w == a for w, a in zip(wanted, actual, strict=True)
    )
    if not fits:
        expected = ", ".join("..." if d is ... else "any" if d is None else str(d) for d in shape)
        comma = "," if len(shape) == 1 else ""
        raise ShapeError(f"{name} has shape {array.shape}; expected ({expected}{comma})")
    return array


def rows_of(record: Record, rows: IntArray | BoolArray | slice) -> Record:
    """Return a dataclass of arrays with some rows of each, and of the records in it; all else stays."""
    chosen: dict[str, Any] = {}
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, np.ndarray):
            chosen[field.name] = value[rows]
        elif is_dataclass(value) and not isinstance(value, type):
            chosen[field.name] = rows_of(value, rows)
    return replace(record, **chosen)


def with_rows(record: Record, rows: IntArray | BoolArray, by: Record) -> Record:
    """Return a dataclass of arrays, and of records of them, with some rows replaced by those of another."""
    changed: dict[str, Any] = {}
    for field in fields(record):
        value, new = getattr(record, field.name), getattr(by, field.name)
        if isinstance(value, np.ndarray):
            changed[field.name] = value.copy()
            changed[field.name][rows] = new
        elif is_dataclass(value) and not isinstance(value, type):
            changed[field.name] = with_rows(value, rows, new)
    return replace(record, **changed)
