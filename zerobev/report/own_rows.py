"""Rows and claims that this project adds to the paper's tables, as data."""

from zerobev.report.paper import Ordering

#: table -> row -> method; table 6 is not in the paper
OWN_ROWS: dict[int, dict[str, str]] = {
    2: {
        "f": "+ aux (obstacles + navigable), max-pooling attention",
        "f.r": "+ aux (obstacles + navigable), max-pooling attention, residual",
    },
    6: {
        "c": "the recipe of this scale",
        "c.fixed": "... with textures of the paper's scale alone",
        "c.mesh": "... without extruded textures",
        "c.once": "... with one texture per home, instead of one per sample",
        "c.paper": "the paper's textures, no empty samples, plain initial weights",
    },
}

#: Ids begin with the number of the table.
OWN_CLAIMS: tuple[Ordering, ...] = (
    Ordering("2.f1", "class", "attention that max-pools beats attention that averages", "f", "c"),
    Ordering("2.f2", "class", "attention that max-pools beats the inductive bias", "f", "e"),
    Ordering("2.f3", "class", "max-pooling beats averaging in the residual model", "f.r", "d"),
    Ordering("6.1", "class", "textures of random scale beat those of one scale", "c", "c.fixed"),
    Ordering("6.2", "class", "extruded textures in part of the samples beat none", "c", "c.mesh"),
    Ordering("6.3", "class", "a new texture per sample beats one per home", "c", "c.once"),
    Ordering("6.4", "class", "the short recipe beats the paper's choices in a short training", "c", "c.paper"),
)
