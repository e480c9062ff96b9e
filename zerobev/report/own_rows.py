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
        "c.mesh": "... with all textures painted on the mesh, none from above",
        "c.once": "... with one texture a scene, not a new one for every sample",
        "c.paper": "the paper's textures, no blank samples, plain first weights",
    },
}

#: Ids begin with the number of the table.
OWN_CLAIMS: tuple[Ordering, ...] = (
    Ordering("2.f1", "class", "attention that max-pools beats attention that averages", "f", "c"),
    Ordering("2.f2", "class", "... and the inductive bias", "f", "e"),
    Ordering("2.f3", "class", "... also where both know the projection", "f.r", "d"),
    Ordering("6.1", "class", "textures of drawn scale beat those of one scale", "c", "c.fixed"),
    Ordering("6.2", "class", "painting what is raised from above, too, beats the mesh alone", "c", "c.mesh"),
    Ordering("6.3", "class", "new textures for every sample beat one a scene", "c", "c.once"),
    Ordering("6.4", "class", "the short recipe beats the paper's choices in a short training", "c", "c.paper"),
)
