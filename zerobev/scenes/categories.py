"""Object names of HM3DSem to the eight evaluated classes, and to ceilings."""

import re

from zerobev.config import LABELS, NO_LABEL

#: The last noun of a name decides its class; annotators' misspellings are included.
_NOUNS = {
    "wall": "wall wal walll baseboard molding niche paneling relief",
    "floor": "floor floer florr floormat mat bathmat doormat rug carpet cerpet gravel landing lawn pavement paving",
    "chair": "chair chairs cair chiar armchair aemchair armchir highchair highchairs recliner beanbag chaise",
    "sofa": "sofa couch",
    "bed": "bed bedframe bedpost headboard mattress hammock cradle",
    "plant": "plant plants flower flowers tree grass vegetation",
    "toilet": "toilet tailet toiled toilete toliet tolilet bidet",
    "tv": "tv monitor whiteboard",
}

#: Whole names of a class that their last noun does not show.
_ALSO = {
    "wall": "skirting board, tool board, tool rack, wall balk, wall balks, wall coping, wall corridor, wall of green, "
    "wall outside, wall panel, wall panel frame, wallkitchen island",
    "floor": "floor frame, foor frame",
    "sofa": "chaise longue, sofa set",
    "bed": "bed base, bed frame, bed sheet",
    "plant": "twigs in vase, unknown/ probably decorative plant",
    "toilet": "cat litter box, chamber pot, toilet seat",
    "tv": "bulletin board, display, tube, tv led, unknown/ probably home theater player",
}

#: Whole names without a class that end with one of the nouns.
_NEITHER = (
    "bath wall, ceiling molding, ceiling wall, closet mirror wall, compound wall, fireplace wall, recessed wall, "
    "shower wall, stair wall, wall niche, closet floor, fireplace floor, patio floor, shower floor, excercise mat, "
    "exercise mat, joga mat, place mat, training mat, yoga mat, rolled carpet, baby chair, row of theater chairs, "
    "pet bed, bonsai tree, cat tree, christmas tree, decoration plant, decorative plant, decorative plants, "
    "decoratrive plant, dried flowers, led tv, wall tv"
)

#: A name that ends with one of these nouns is a ceiling; misspellings are included.
_CEILINGS = frozenset(["ceiling", "ceilling", "ceiiling", "ceiilng", "ceiliing", "celing", "cieling", "roof"])
_CEILINGS_TOO = frozenset(("ceiling panel", "ceiling panels"))
_NO_CEILING = "lamp ceiling"

_LABEL_OF_NOUN = {noun: LABELS.index(label) for label, nouns in _NOUNS.items() for noun in nouns.split()}
_LABEL_OF_NAME = {name: LABELS.index(label) for label, names in _ALSO.items() for name in names.split(", ")}
_LABEL_OF_NAME |= dict.fromkeys(_NEITHER.split(", "), NO_LABEL)


def label_of(name: str) -> int:
    """Index into `config.LABELS` of an object called `name`, or `NO_LABEL`; case and runs of spaces do not matter.

    Names are the free text of HM3DSem's annotators. The rule: a whole name in one of two short lists of exceptions,
    else the last noun ("office chair" is a chair, "chair stand" is not). A leading "unknown/ probably" and trailing
    notes such as "/outside" are ignored. All 1,624 names of release 0.2 get the same class as in habitat-sim's table
    of Matterport3D's forty categories.

    Consequences: armchairs, recliners and beanbags are chairs; stools, ottomans, benches and plain seats are not; rugs,
    carpets and most mats are floor; monitors and whiteboards are tv; bidets are toilets; baseboards are wall;
    "decorative plant" and vases are not plants, "plant" and "flowers" are.
    """
    tidy = _tidy(name)
    if tidy in _LABEL_OF_NAME:
        return _LABEL_OF_NAME[tidy]
    tidy = _without_notes(tidy)
    if tidy in _LABEL_OF_NAME:
        return _LABEL_OF_NAME[tidy]
    return _LABEL_OF_NOUN.get(tidy.rpartition(" ")[2], NO_LABEL)


def is_ceiling(name: str) -> bool:
    """Whether an object called `name` is a ceiling or a roof; the last noun decides, as in `label_of`.

    "kitchen ceiling" and "ceilling" are ceilings, "ceiling lamp" and "ceiling fan" are not.
    """
    tidy = _without_notes(_tidy(name))
    return tidy in _CEILINGS_TOO or (tidy.rpartition(" ")[2] in _CEILINGS and tidy != _NO_CEILING)


def _tidy(name: str) -> str:
    return " ".join(name.lower().split())


def _without_notes(tidy: str) -> str:
    return re.sub(r"^unknown ?/ ?(probably )?", "", tidy).split("/")[0].strip()
