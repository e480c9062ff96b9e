"""Short names of the tables' rows, for figures and sentences."""

NAMES = {
    "a.1": "P^-1, true depth",
    "a.2": "P^-1, estimated depth",
    "b.1": "VPN, not zero-shot",
    "b.2": "TIM, not zero-shot",
    "b.3": "TIM with segmentation, not zero-shot",
    "c": "Zero-BEV",
    "d": "Zero-BEV, residual",
    "-": "Zero-BEV without auxiliary maps",
    "c.I": "Zero-BEV, obstacles alone",
    "c.II": "Zero-BEV, navigable alone",
    "d.I": "residual without auxiliary maps",
    "e": "inductive bias",
    "f": "max-pooling attention",
    "f.r": "max-pooling attention, residual",
    "d.gt": "residual, true depth in training",
    "d.predicted": "residual, estimated depth in training",
    "c.10": "10 % white",
    "c.15": "15 % white",
    "c.25": "25 % white",
    "c.30": "30 % white",
    "c.modsem": "Mod. Sem.",
    "c.depthproj": "Depth proj.",
    "c.fixed": "textures of one scale",
    "c.mesh": "no extruded textures",
    "c.once": "one texture per home",
    "c.paper": "the paper's choices",
}


def named(row: str, letter: bool = True) -> str:
    """`(c) Zero-BEV` or, without the letter, `Zero-BEV`; a row without a name has its letter alone."""
    name = NAMES.get(row, "")
    return f"({row}) {name}".rstrip() if letter or not name else name
