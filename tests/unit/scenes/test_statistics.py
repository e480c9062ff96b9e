"""Statistics of homes: hand-made scenes with known counts."""

import re

import pytest

from zerobev.common.errors import InputError
from zerobev.scenes.categories import label_of
from zerobev.scenes.scene import Instance
from zerobev.scenes.statistics import HM3DSEM, home_statistics


def scene(*rooms: str, first_region: int = 0) -> tuple[Instance, ...]:
    """One scene: a comma-separated list of names per room."""
    rows = [(name, r) for r, names in enumerate(rooms, start=first_region) for name in names.split(", ")]
    return tuple(Instance(i, (i, 0, 0), name, r, label_of(name)) for i, (name, r) in enumerate(rows, start=1))


SCENES = [
    scene("wall, wall, floor, bed, chair, armchair, lamp", "wall, floor, toilet, unknown"),
    scene("wall, wall, wall, floor, bed, rug, office chair, plant, plant, plant, tv"),
]
KINDS = [["bedroom", "bathroom"], ["bedroom"]]


def test_known_counts():
    found = home_statistics(SCENES, KINDS)
    assert (found.scenes, found.rooms) == (2, 3)
    assert found.objects_mean == pytest.approx((7 + 4 + 11) / 3)
    assert found.objects_median == 7
    assert found.walls == pytest.approx(2)
    expected = {"wall": 3, "floor": 3, "chair": 2, "sofa": 0, "bed": 2, "plant": 1, "toilet": 1, "tv": 1}
    assert found.fraction == pytest.approx({label: count / 3 for label, count in expected.items()})
    assert {key: mean for key, mean in found.mean.items() if mean and key[1] not in ("wall", "floor")} == {
        ("bedroom", "chair"): 1.5, ("bedroom", "bed"): 1.0, ("bedroom", "plant"): 1.5, ("bedroom", "tv"): 0.5,
        ("bathroom", "toilet"): 1.0,
    }  # fmt: skip
    assert found.mean["bathroom", "bed"] == 0
    assert found.mean["bedroom", "floor"] == 1.5


def test_one_table_names_every_number():
    table = home_statistics(SCENES, KINDS).numbers
    assert table["rooms per scene"] == 1.5
    assert table["rooms with chair"] == pytest.approx(2 / 3)
    assert table["plant in bedroom"] == 1.5
    assert set(HM3DSEM.numbers) - set(table) == {  # no such rooms here
        f"{label} in {kind}" for kind, label in HM3DSEM.mean if kind not in ("bedroom", "bathroom")
    }
    assert HM3DSEM.numbers["rooms per scene"] == pytest.approx(14.36, abs=0.01)


def test_instances_without_a_room_are_left_out():
    outside = scene("sofa, wall", first_region=-1)
    assert home_statistics([*SCENES, outside]).fraction == home_statistics(SCENES).fraction
    assert home_statistics([*SCENES, outside]).scenes == 3
    with pytest.raises(InputError, match="none in 1 scenes"):
        home_statistics([outside])


def test_kinds_are_optional_but_complete():
    assert home_statistics(SCENES).mean == {}
    for short, where in ((KINDS[:1], "region 0 of scene 1"), ([["bedroom"], ["bedroom"]], "region 1 of scene 0")):
        with pytest.raises(InputError, match=re.escape(f"expected a kind for {where}")):
            home_statistics(SCENES, short)
