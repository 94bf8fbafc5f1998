"""Values of callers on their way to a message or to JSON: what cannot be sent is named with its field."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

import numpy as np
from google.protobuf.descriptor import FieldDescriptor

from .errors import invalid

T = TypeVar("T")

_ACCEPTED = {
    FieldDescriptor.CPPTYPE_UINT64: "a whole number, 0 to 2^64 - 1",
    FieldDescriptor.CPPTYPE_UINT32: "a whole number, 0 to 2^32 - 1",
    FieldDescriptor.CPPTYPE_DOUBLE: "a number",
    FieldDescriptor.CPPTYPE_BOOL: "True or False",
}


def made(kind: type[T], **values: Any) -> T:
    """A message with these fields; None leaves a field out.

    Raises:
        InvalidArgument: a field has another type or range.
    """
    try:
        return kind(**values)
    except (TypeError, ValueError):
        for name, value in values.items():
            try:
                kind(**{name: value})
            except (TypeError, ValueError):
                raise invalid(name, _shown(value), _accepted(kind, name)) from None
        raise


def _accepted(kind: Any, name: str) -> str:
    """What a field of a message accepts."""
    field = kind.DESCRIPTOR.fields_by_name[name]
    if field.cpp_type == FieldDescriptor.CPPTYPE_STRING:
        one = "bytes" if field.type == FieldDescriptor.TYPE_BYTES else "a str"
    else:
        one = _ACCEPTED.get(field.cpp_type, "values of its type")
    single = isinstance(getattr(kind(), name), (str, bytes, int, float))
    return one if single else f"a list, each {one}"


def text(field: str, value: Any) -> str:
    """A value that is a str.

    Raises:
        InvalidArgument: it is not.
    """
    if not isinstance(value, str):
        raise invalid(field, _shown(value), "a str")
    return value


def texts(field: str, values: Any) -> list[str]:
    """Values that are each a str.

    Raises:
        InvalidArgument: one is not, or they are not several.
    """
    return [text(f"{field}[{i}]", value) for i, value in enumerate(several(field, values))]


def several(field: str, values: Any) -> list[Any]:
    """Values in a list, a tuple or something else that has several; not the letters of a text.

    Raises:
        InvalidArgument: they are not several.
    """
    if isinstance(values, (str, bytes)) or not isinstance(values, Iterable):
        raise invalid(field, _shown(values), "a list")
    return list(values)


def mapping(field: str, given: Any) -> Mapping[Any, Any]:
    """A mapping.

    Raises:
        InvalidArgument: it is none.
    """
    if not isinstance(given, Mapping):
        raise invalid(field, _shown(given), "a mapping")
    return given


def instance(field: str, value: Any, kind: type[T]) -> T:
    """A value of a class.

    Raises:
        InvalidArgument: it is of another one.
    """
    if not isinstance(value, kind):
        raise invalid(field, _shown(value), f"a {kind.__module__.partition('.')[0]}.{kind.__name__}")
    return value


def number(field: str, value: Any) -> float:
    """A value that is a number.

    Raises:
        InvalidArgument: it is not.
    """
    try:
        return float(value)
    except (TypeError, ValueError):
        raise invalid(field, _shown(value), "a number") from None


def whole(field: str, value: Any, least: int, most: int) -> int:
    """A whole number within bounds, also one of numpy.

    Raises:
        InvalidArgument: it is none.
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or not least <= value <= most:
        raise invalid(field, _shown(value), f"a whole number, {least} to {most}")
    return int(value)


def plain(field: str, value: Any) -> Any:
    """A value as JSON has it: numbers and arrays of numpy become numbers and lists.

    Raises:
        InvalidArgument: JSON does not have it.
    """
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise invalid(field, value, "a finite number")
        return value
    if isinstance(value, Mapping):
        return {_key(field, key): plain(f"{field}.{key}" if field else str(key), one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(f"{field}[{i}]", one) for i, one in enumerate(value)]
    raise invalid(field, _shown(value), "a value that JSON has: a number, a str, a bool, None, a list or a dict")


def _key(field: str, key: Any) -> str:
    if isinstance(key, (str, int, np.integer)):
        return str(key)
    raise invalid(field, _shown(key), "names of fields, each a str")


def _shown(value: Any) -> str:
    """The value so that the text `'5'` and the number `5` differ."""
    return str(value) if isinstance(value, (int, float, np.generic)) else repr(value)
