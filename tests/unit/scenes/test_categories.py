"""Names of HM3DSem to classes: pinned names, and all of habitat-sim's table if it is available."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zerobev.config import LABELS, NO_LABEL
from zerobev.scenes.categories import is_ceiling, label_of

from support.paths import SHARED

TABLE = SHARED / "hm3dsem/category_mappings.tsv"

PINNED = {
    "wall": ["wall", "bathroom wall", "skirting board", "wall /outside", "unknown wall", "wall panel", "walll"],
    "floor": ["floor", "rug", "carpet", "bath mat", "doormat", "bathroom  mat", "unknown/ probably rug", "foor frame"],
    "chair": ["chair", "armchair", "office chair", "highchairs", "bean bag chair", "chair /w clutter", "chaise"],
    "sofa": ["sofa", "couch", "chaise longue", "l-shaped sofa", "unknown/ probably sofa"],
    "bed": ["bed", "bunk bed", "bed frame", "mattress", "dog bed"],
    "plant": ["plant", "flowers", "tree", "vase with flower", "unknown/ probably decorative plant"],
    "toilet": ["toilet", "toliet", "bidet", "toilet seat"],
    "tv": ["tv", "monitor", "plasma tv", "whiteboard", "unknown/ probably monitor"],
    None: [
        *["stool", "ottoman", "bench", "baby chair", "chair stand", "sofa seat", "bedside table", "bed lamp", "vase"],
        *[
            "decorative plant",
            "christmas tree",
            "flower pot",
            "toilet paper",
            "tv stand",
            "wall tv",
            "keyboard",
            "door",
        ],
        *[
            "wall lamp",
            "shower wall",
            "ceiling",
            "yoga mat",
            "shower floor",
            "floor lamp",
            "window /wall",
            "unknown",
            "",
        ],
    ],
}


@pytest.mark.parametrize(("label", "name"), [(label, name) for label, names in PINNED.items() for name in names])
def test_pinned_names(label: str | None, name: str) -> None:
    assert label_of(name) == (NO_LABEL if label is None else LABELS.index(label))


def test_case_and_spaces_do_not_matter() -> None:
    for names in PINNED.values():
        for name in names:
            assert label_of(f"  {name.upper().replace(' ', '   ')} ") == label_of(name)


@given(st.text())
def test_every_text_has_a_label(name: str) -> None:
    assert label_of(name) in range(NO_LABEL, len(LABELS))


@given(st.text(st.characters(codec="ascii", categories=["Ll"]), min_size=1))
def test_the_last_noun_decides(first: str) -> None:
    assert label_of(f"q{first} sofa") == LABELS.index("sofa")
    assert label_of(f"sofa q{first}") == NO_LABEL


@pytest.mark.skipif(not TABLE.exists(), reason=f"needs habitat-sim's table of names, {TABLE.name}")
def test_agrees_with_the_whole_table() -> None:
    rows = [line.split("\t") for line in TABLE.read_text().splitlines()[1:]]
    of_raw = {raw: mpcat40 for raw, _, mpcat40 in rows}
    of_name = {category: mpcat40 for _, category, mpcat40 in rows} | of_raw
    assert len(of_name) > 2000
    index = {"tv_monitor" if label == "tv" else label: position for position, label in enumerate(LABELS)}
    expected = {name: index.get(mpcat40, NO_LABEL) for name, mpcat40 in of_name.items()}
    assert {name: label_of(name) for name in expected} == expected


@pytest.mark.parametrize("name", ["ceiling", " Ceilling", "kitchen  ceiling", "roof", "ceiling panel", "ceiling /room"])
def test_ceilings(name: str) -> None:
    assert is_ceiling(name) and label_of(name) == NO_LABEL


@pytest.mark.parametrize("name", ["ceiling lamp", "lamp ceiling", "ceiling fan", "roof window", "floor", ""])
def test_other_names_are_not_ceilings(name: str) -> None:
    assert not is_ceiling(name)


@pytest.mark.skipif(not TABLE.exists(), reason=f"needs habitat-sim's table of names, {TABLE.name}")
def test_every_spelling_of_ceiling_in_the_table_is_recognised() -> None:
    rows = [line.split("\t") for line in TABLE.read_text().splitlines()[1:]]
    assert all(is_ceiling(raw) for raw, category, _ in rows if category in ("ceiling", "roof", "ceiling panel"))
    assert not any(is_ceiling(raw) for raw, _, mpcat40 in rows if mpcat40 in ("lighting", "floor", "wall", "door"))
