"""Which runs the tables need, as data; a row that stands in several tables is one run."""

from dataclasses import dataclass, replace

from zerobev.common.errors import InputError
from zerobev.config import ModelConfig, Scale, TextureConfig
from zerobev.models.variants import VARIANTS


@dataclass(frozen=True)
class Experiment:
    """One row of a table: a network trained on a stream, or the projection P^-1, which is not trained."""

    row: str
    network: str | None = "c"  #: a row of `models.variants.VARIANTS`; None for P^-1
    stream: str = "synth"  #: zero-shot stream of training: "synth", "modsem", "depthproj", or "classes" (not zero-shot)
    white_fraction: float = 0.20  #: of white texels (Synth)
    scales: tuple[float, float] | None = None  #: see `TextureConfig.scales`; None: those of the scale
    fresh: bool = True  #: a new texture for every sample; else one a scene, as in the paper
    extruded: float | None = None  #: see `Scale.extruded_fraction`; None: that of the scale
    paper_start: bool = False  #: as in the paper: no empty samples, no extruded textures, plain first weights
    train_depth: tuple[str, ...] = ("gt",)  #: "gt" or "predicted", one stage of training after the other
    test_depth: str = "predicted"  #: what P^-1 and the residual model get in the test

    @property
    def reads_depth(self) -> bool:
        """Whether depth is among its inputs: else the two fields above mean nothing."""
        return self.network is None or VARIANTS[self.network][1].get("residual", False)

    def texture(self, scale: Scale) -> TextureConfig:
        """The textures that it is trained on."""
        return replace(scale.texture, white_fraction=self.white_fraction, scales=self.scales or scale.texture.scales)

    def model(self, scale: Scale) -> ModelConfig:
        """The network's configuration; its variant is not yet part of it."""
        if not self.paper_start:
            return scale.model
        return replace(
            scale.model, ground_start=False, zero_init_gain=1.0, residual_init_gain=1.0, foreground_prior=0.5
        )

    def extruded_fraction(self, scale: Scale) -> float:
        """The fraction of samples whose texture is extruded."""
        if self.extruded is not None:
            return self.extruded
        return 0.0 if self.paper_start else scale.extruded_fraction

    def empty_fraction(self, scale: Scale) -> float:
        """The fraction of empty samples. The masks of the classes need none: many are empty."""
        return 0.0 if self.paper_start or self.stream == "classes" else scale.empty_fraction


def _experiments() -> dict[str, Experiment]:
    stages = ("gt", "predicted")
    rows = (
        # Table 1
        Experiment("a.1", None, test_depth="gt"),
        Experiment("b.1", "b.1", stream="classes"),
        Experiment("b.2", "b.2", stream="classes"),
        Experiment("b.3", "b.3", stream="classes"),
        Experiment("a.2", None),
        Experiment("c"),
        Experiment("d", "d", train_depth=stages),
        # Table 2
        Experiment("-", "-"),
        Experiment("c.I", "c.I"),
        Experiment("c.II", "c.II"),
        Experiment("d.I", "d.I", train_depth=stages),
        Experiment("e", "e"),
        Experiment("f", "f"),
        Experiment("f.r", "f.r", train_depth=stages),
        # Table 3
        Experiment("d.gt", "d"),
        Experiment("d.predicted", "d", train_depth=("predicted",)),
        # Table 4
        Experiment("c.10", white_fraction=0.10),
        Experiment("c.15", white_fraction=0.15),
        Experiment("c.25", white_fraction=0.25),
        Experiment("c.30", white_fraction=0.30),
        # Table 5
        Experiment("c.modsem", stream="modsem"),
        Experiment("c.depthproj", stream="depthproj"),
        # beyond the paper: how large structures are, what they are painted on, how often they change, and the paper's
        # choice in all we differ in
        Experiment("c.fixed", scales=(1.0, 1.0)),
        Experiment("c.mesh", extruded=0.0),
        Experiment("c.once", fresh=False),
        Experiment("c.paper", scales=(1.0, 1.0), fresh=False, paper_start=True),
    )
    return {experiment.row: experiment for experiment in rows}


#: row -> run, in the order in which they are worth having
EXPERIMENTS = _experiments()


def experiment(row: str) -> Experiment:
    """The run of a row; an unknown row is an `InputError` that lists the known ones."""
    if row not in EXPERIMENTS:
        raise InputError(f"row: expected one of {', '.join(EXPERIMENTS)}, found {row!r}")
    return EXPERIMENTS[row]
