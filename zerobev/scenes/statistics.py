"""Numbers of rooms, objects and classes in scenes, and the same numbers for HM3DSem.

The reference `HM3DSEM` was counted in the `.semantic.txt` files of the 181 annotated scenes of HM3DSem v0.2 (Yadav et
al., "Habitat-Matterport 3D Semantics Dataset", CVPR 2023), which are not part of this repository. Its 2,599 rooms are
their regions; the kind of a room follows from its objects, since the files do not name kinds. HM3DSem's scenes are
larger than generated homes: 5, 50 and 95 % of them have up to 42, 92 and 242 m2 of navigable floor, flats 23, 41 and
57 m2, varied homes 22, 49 and 99 m2.
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
    """Contents of the rooms of a set of scenes; objects are all instances of a room, including walls and floor."""

    scenes: int
    rooms: int
    objects_mean: float  #: per room
    objects_median: float  #: per room
    walls: float  #: instances of class wall per room
    fraction: dict[str, float]  #: of the rooms with an instance of the class
    mean: dict[tuple[str, str], float]  #: number per room, by kind of room and class

    @property
    def numbers(self) -> dict[str, float]:
        """All numbers as one table: description -> value."""
        table = {
            "rooms per scene": self.rooms / self.scenes,
            "objects per room, mean": self.objects_mean,
            "objects per room, median": self.objects_median,
            "walls per room": self.walls,
        }
        table |= {f"rooms with {label}": fraction for label, fraction in self.fraction.items()}
        return table | {f"{label} in {kind}": mean for (kind, label), mean in self.mean.items()}


HM3DSEM = HomeStatistics(
    scenes=181,
    rooms=2599,
    objects_mean=46.0,
    objects_median=36.0,
    walls=8.2,
    fraction={"chair": 0.36, "bed": 0.21, "toilet": 0.18, "tv": 0.15, "plant": 0.14, "sofa": 0.13},
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
    """Count rooms and their objects, from the instances of each scene; a room is a region >= 0 of a scene.

    `kinds` holds the kind of each region of each scene, if known; `mean` then covers these kinds and all eight classes,
    else it is empty. No room is an `InputError`, and so is a region without a kind.
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
        fraction={label: float(np.mean([room[label] > 0 for room in rooms.values()])) for label in LABELS},
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
