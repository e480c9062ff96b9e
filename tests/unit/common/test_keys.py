"""Keys depend only on values that differ from their defaults."""

from dataclasses import dataclass, field, make_dataclass, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zerobev.common.keys import changed, fingerprint, matches, plain
from zerobev.config import SCALES


@dataclass(frozen=True)
class Inner:
    size: int
    gain: float = 1.0


@dataclass(frozen=True)
class Outer:
    inner: Inner
    names: tuple[str, ...] = ("a", "b")
    more: Inner = field(default_factory=lambda: Inner(7))


def test_default_values_are_left_out():
    assert changed(Outer(Inner(3))) == {"inner": {"size": 3}}
    assert changed(Outer(Inner(3, 2.0), ("a",))) == {"inner": {"size": 3, "gain": 2.0}, "names": ["a"]}
    assert plain(Outer(Inner(3)))["more"] == {"size": 7, "gain": 1.0}
    with pytest.raises(TypeError, match="expected plain data"):
        plain({"a": object()})


def test_new_fields_with_defaults_change_no_key():
    """With a new field in every dataclass of a scale, keys are the same and earlier records match."""

    def grown(value):
        kind = make_dataclass("Grown", [("new", int, field(default=3))], bases=(type(value),), frozen=True)
        return kind(**vars(value))

    for scale in SCALES.values():
        for part in (scale.camera, scale.scenes, scale.model, scale.train, scale.depth, scale.texture):
            assert fingerprint({"part": grown(part)}) == fingerprint({"part": part})
            assert matches(plain(part), grown(part))
            assert not matches(plain(part), replace(grown(part), new=4))


@given(st.integers(), st.floats(allow_nan=False), st.lists(st.text(max_size=3), max_size=3))
def test_stored_data_match_only_their_own_value(size, gain, names):
    value = Outer(Inner(size, gain), tuple(names))
    assert matches(plain(value), value)
    assert matches({"run": plain(value)}, {"run": value}) and not matches({"run": plain(value)}, {"walk": value})
    assert not matches(plain(value), replace(value, inner=Inner(size + 1, gain)))
    assert not matches(plain(value) | {"old": 1}, value)
    assert (fingerprint(value) == fingerprint(Outer(Inner(size)))) == (gain == 1.0 and names == ["a", "b"])
