"""Leaves out of a message what a newer writer has added, so that an older reader understands the rest."""

from functools import cache
from typing import Any

import msgspec

_type_info = cache(msgspec.inspect.type_info)


def without_unknown_fields(data: object, kind: Any) -> object:
    """Return plain data without the fields that ``kind`` does not have, at any depth.

    Nothing else is looked at: what is wrong stays wrong, for the checked conversion to refuse.

    Parameters
    ----------
    data : object
        What a msgpack decoder returned.
    kind : type
        A `msgspec.Struct`, or anything else that `msgspec` can check.

    Examples
    --------
    >>> class Point(msgspec.Struct):
    ...     x: int
    >>> without_unknown_fields({"x": 1, "colour": "red"}, Point)
    {'x': 1}
    """
    return _pruned(data, _type_info(kind))


def _pruned(data: object, kind: msgspec.inspect.Type) -> object:
    match kind:
        case msgspec.inspect.Metadata(type=inner):
            return _pruned(data, inner)
        case msgspec.inspect.StructType() if isinstance(data, dict):
            types = {field.encode_name: field.type for field in kind.fields}
            return {
                key: _pruned(value, types[key]) if key in types else value
                for key, value in data.items()
                if key in types or key == kind.tag_field
            }
        case msgspec.inspect.ListType(item_type=item) if isinstance(data, list):
            return [_pruned(value, item) for value in data]
        case msgspec.inspect.UnionType() if isinstance(data, dict):
            structs = [t for t in kind.types if isinstance(t, msgspec.inspect.StructType)]
            for struct in structs:
                if struct.tag_field is None or data.get(struct.tag_field) == struct.tag:
                    return _pruned(data, struct)
            return data
        case _:
            return data
