"""How full homes are, and of what: rooms, objects and classes, beside the same numbers of HM3DSem.

The reference `HM3DSEM` is of the 181 annotated scenes of HM3DSem v0.2 and their 2,599 rooms, the regions of its
`.semantic.txt` files. HM3DSem's homes are larger than generated ones: 5, 50 and 95 % of its
scenes have up to 42, 92 and 242 m2 of navigable floor, where generated homes have 23, 41 and 57 m2.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from zerobev.common.errors import InputError
from zerobev.config import LABELS, NO_LABEL
from zerobev.scenes.scene import Instance


@dataclass(frozen=True)
class HomeStatistics:
    """What a set of scenes has in its rooms; an object is any instance of a room, its walls and floor included."""

    scenes: int
    rooms: int
    objects_mean: float  #: a room
    objects_median: float  #: a room
    walls: float  #: instances of class wall a room
    share: dict[str, float]  #: of rooms that contain the class
    mean: dict[tuple[str, str], float]  #: number in a room, by kind of room and class

    @property
    def numbers(self) -> dict[str, float]:
        """All of it as one table, by what each number is."""
        table = {
            "rooms a scene": self.rooms / self.scenes,
            "objects a room, mean": self.objects_mean,
            "objects a room, median": self.objects_median,
            "walls a room": self.walls,
        }
        table |= {f"rooms with {label}": share for label, share in self.share.items()}
        return table | {f"{label} in {kind}": mean for (kind, label), mean in self.mean.items()}


HM3DSEM = HomeStatistics(
    scenes=181,
    rooms=2599,
    objects_mean=46.0,
    objects_median=36.0,
    walls=8.2,
    share={"chair": 0.36, "bed": 0.21, "toilet": 0.18, "tv": 0.15, "plant": 0.14, "sofa": 0.13},
    mean={
        ("bedroom", "bed"): 1.03, ("bedroom", "chair"): 0.59, ("bedroom", "tv"): 0.22, ("bedroom", "plant"): 0.19,
        ("bathroom", "toilet"): 0.87, ("bathroom", "plant"): 0.11, ("living room", "chair"): 3.0,
        ("living room", "sofa"): 1.2, ("living room", "plant"): 1.0, ("living room", "tv"): 0.56,
        ("kitchen", "chair"): 3.4, ("kitchen", "plant"): 0.63, ("office", "chair"): 2.2, ("office", "tv"): 0.78,
        ("dining room", "chair"): 6.3, ("hall", "chair"): 0.55, ("hall", "plant"): 0.31,
    },
)  # fmt: skip


def home_statistics(
    scenes: Sequence[Sequence[Instance]], kinds: Sequence[Sequence[str]] | None = None
) -> HomeStatistics:
    """Count rooms and what is in them, in the instances of each scene; a room is a region >= 0 of a scene.

    `kinds` holds the kind of each region of each scene, where they are known; the means by kind cover its kinds, all
    eight classes each. Without them `mean` is empty. No room at all is an `InputError`, and so is a region
    without a kind.
    """
    rooms: dict[tuple[int, int], Counter[str]] = {}
    for number, instances in enumerate(scenes):
        for instance in instances:
            if instance.region >= 0:
                room = rooms.setdefault((number, instance.region), Counter())
                room["object"] += 1
                if instance.label != NO_LABEL:
                    room[LABELS[instance.label]] += 1
    if not rooms:
        raise InputError(f"scenes: expected an instance in a region >= 0, found none in {len(scenes)} scenes")
    objects = [room["object"] for room in rooms.values()]
    return HomeStatistics(
        scenes=len(scenes),
        rooms=len(rooms),
        objects_mean=float(np.mean(objects)),
        objects_median=float(np.median(objects)),
        walls=_mean(list(rooms.values()), "wall"),
        share={label: float(np.mean([room[label] > 0 for room in rooms.values()])) for label in LABELS},
        mean={} if kinds is None else _means_by_kind(rooms, kinds),
    )


def _means_by_kind(
    rooms: dict[tuple[int, int], Counter[str]], kinds: Sequence[Sequence[str]]
) -> dict[tuple[str, str], float]:
    of_kind: dict[str, list[Counter[str]]] = {}
    for (number, region), room in rooms.items():
        if number >= len(kinds) or region >= len(kinds[number]):
            raise InputError(f"kinds: expected a kind for region {region} of scene {number}, found none")
        of_kind.setdefault(kinds[number][region], []).append(room)
    return {(kind, label): _mean(of_kind[kind], label) for kind in sorted(of_kind) for label in LABELS}


def _mean(rooms: list[Counter[str]], label: str) -> float:
    return float(np.mean([room[label] for room in rooms]))
