"""Generated homes in tests: their designs, plans and solids."""

from collections import Counter

import numpy as np

from zerobev.scenes.indoor.buildings import draw_building
from zerobev.scenes.indoor.furniture import (
    bathroom,
    beds,
    clutter,
    household,
    plants,
    screens,
    seating,
    storage,
    tables,
)
from zerobev.scenes.indoor.plan import draw_plan
from zerobev.scenes.indoor.style import draw_style

SHELL = {"wall", "floor", "ceiling", "door frame", "door", "window"}
DESIGNS = {
    "chair": seating.CHAIRS,
    "sofa": seating.SOFAS,
    "bed": beds.BEDS,
    "plant": plants.PLANTS,
    "toilet": bathroom.TOILETS,
    "tv": screens.SCREENS,
}
OTHERS = (
    seating.stool, seating.ottoman, seating.bench, tables.dining_table, tables.round_table, tables.coffee_table,
    tables.side_table, tables.console, tables.desk, storage.nightstand, storage.drawers, storage.sideboard,
    storage.tv_stand, storage.wardrobe, storage.shoe_cabinet, storage.bookshelf, storage.wall_shelf,
    storage.kitchen_island, storage.washing_machine, *bathroom.SINKS, *bathroom.WASHING, bathroom.towel_rail,
    *clutter.ON_TABLES, *clutter.ON_SHELVES, *clutter.ON_DESKS, *clutter.ON_WORKTOPS, *clutter.ON_FLOORS,
    clutter.table_lamp, clutter.floor_lamp, clutter.ceiling_lamp, clutter.painting, clutter.mirror, clutter.clock,
    clutter.radiator, clutter.shoes, clutter.coat_rack, clutter.keyboard, household.clothes_rail,
    household.linen_shelf, household.iron, household.boiler, *household.IN_CLOSETS, *household.TOOLS,
)  # fmt: skip


def plan(homes, seed):
    """The rooms of `build_home` with this seed."""
    rng = np.random.default_rng(seed)
    if homes == "flats":
        return draw_plan(rng)
    draw_style(rng)
    return draw_building(rng)


def triangles(quads):
    """The quads' triangles with an area, (F, 3, 3)."""
    both = np.asarray(quads, float)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    return both[np.linalg.norm(np.cross(both[:, 1] - both[:, 0], both[:, 2] - both[:, 0]), axis=1) > 1e-10]


def surplus_edges(triangle):
    """Number of directed edges without their opposite: 0 on closed, consistently wound surfaces."""
    corner = np.unique(np.round(triangle, 5).reshape(-1, 3), axis=0, return_inverse=True)[1].reshape(-1, 3)
    edges = Counter(zip(corner.ravel().tolist(), np.roll(corner, -1, axis=1).ravel().tolist()))
    return sum(count != edges[b, a] for (a, b), count in edges.items())
