"""Settings: text such as `train.steps=2400` that changes values of a frozen configuration."""

import ast
from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from zerobev.common.errors import InputError

T = TypeVar("T")


def changed_by(config: T, settings: Sequence[str]) -> T:
    """A dataclass with some values changed; a path names a value of a nested dataclass.

    settings: `path=value`, with a Python literal as value; quotes around text may be omitted
    Raises `InputError` for an unknown path and for a value of the wrong type.
    """
    for setting in settings:
        path, equals, text = setting.partition("=")
        if not equals:
            raise InputError(f"setting: expected name=value, found {setting!r}")
        config = _changed(config, path.strip().split("."), text.strip(), setting)
    return config


def _changed(config: Any, path: list[str], text: str, setting: str) -> Any:
    name, *rest = path
    known = [field.name for field in fields(config)]
    if name not in known:
        raise InputError(f"setting {setting!r}: expected one of {', '.join(known)}, found {name!r}")
    value = getattr(config, name)
    if is_dataclass(value) and not rest:
        raise InputError(f"setting {setting!r}: expected a value of {name}, such as {name}.{fields(value)[0].name}")
    if rest and not is_dataclass(value):
        raise InputError(f"setting {setting!r}: expected no name below {name}, found {rest[0]!r}")
    if rest:
        return replace(config, **{name: _changed(value, rest, text, setting)})
    try:
        return replace(config, **{name: _parsed(text, get_type_hints(type(config))[name])})
    except ValueError as error:  # wrong type, or refused by the dataclass
        raise InputError(f"setting {setting!r}: {error}") from None


def _parsed(text: str, kind: Any) -> Any:
    """The value of `text`; raises `ValueError` if it is not of type `kind`."""
    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        value = text
    if kind is float and type(value) is int:
        value = float(value)
    if not _is_of(value, kind):
        expected = kind.__name__ if isinstance(kind, type) else str(kind).removeprefix("typing.")
        raise ValueError(f"expected {expected}, found {text!r}")
    return value


def _is_of(value: Any, kind: Any) -> bool:
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return any(_is_of(value, one) for one in arguments)
    if origin is Literal:
        return value in arguments
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        kinds = arguments[:1] * len(value) if arguments[1:] == (Ellipsis,) else arguments
        return len(value) == len(kinds) and all(map(_is_of, value, kinds))
    if kind is float:
        return type(value) in (int, float)
    return type(value) is kind
