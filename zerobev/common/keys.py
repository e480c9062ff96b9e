"""Keys: equal configurations have equal keys, and a new config field with a default changes no key."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Any


def fingerprint(config: Any) -> str:
    """Twelve hexadecimal digits of the SHA-256 of `changed(config)`."""
    return hashlib.sha256(json.dumps(changed(config), sort_keys=True).encode()).hexdigest()[:12]


def changed(value: Any) -> Any:
    """Plain data without dataclass fields equal to their defaults, and without dataclasses that are then empty.

    A field without a default stays. Raises `TypeError` for values other than plain data.
    """
    if is_dataclass(value):
        own = {f.name: getattr(value, f.name) for f in fields(value) if getattr(value, f.name) != _default(f)}
        return changed(own)
    if isinstance(value, Mapping):
        return {name: changed(part) for name, part in value.items() if not _all_default(part)}
    return _plain_leaf(value, changed)


def plain(value: Any) -> Any:
    """Plain data with every field of every dataclass, as after a round trip through JSON."""
    if is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {name: plain(part) for name, part in value.items()}
    return _plain_leaf(value, plain)


def matches(stored: Any, value: Any) -> bool:
    """Whether `stored` equals `plain(value)`; fields missing from `stored` must have their default in `value`."""
    if is_dataclass(value):
        parts = {f.name: (getattr(value, f.name), _default(f)) for f in fields(value)}
    elif isinstance(value, Mapping):
        parts = {name: (part, part if _all_default(part) else MISSING) for name, part in value.items()}
    else:
        return stored == plain(value)
    if not isinstance(stored, Mapping) or stored.keys() - parts.keys():
        return False
    return all(
        matches(stored[name], part) if name in stored else part == default for name, (part, default) in parts.items()
    )


def _all_default(value: Any) -> bool:
    return is_dataclass(value) and changed(value) == {}


def _plain_leaf(value: Any, convert: Any) -> Any:
    if isinstance(value, list | tuple):
        return [convert(item) for item in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"expected plain data in a configuration, found {type(value).__name__}")


def _default(of: Any) -> Any:
    if of.default_factory is not MISSING:
        return of.default_factory()
    return of.default
