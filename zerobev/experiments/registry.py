"""The runs of the tables, as data; a row of several tables is one run."""

from dataclasses import dataclass, replace

from zerobev.config import Depth, ModelConfig, Scale, Stream, TextureConfig, one_of
from zerobev.models.variants import VARIANTS


@dataclass(frozen=True)
class Experiment:
    """One row of a table: a network trained on a stream, or P^-1, which is not trained.

    Raises `InputError` for an unknown network, stream or depth; a test has no "mixed" depth.
    """

    row: str
    network: str | None = "c"  #: a row of `models.variants.VARIANTS`; None for P^-1
    stream: Stream = "synth"  #: zero-shot stream in training
    white_fraction: float = 0.20  #: fraction of white texels of *Synth* textures
    scales: tuple[float, float] | None = None  #: see `TextureConfig.scales`; None: the scale's
    fresh: bool = True  #: a new texture per sample; False: one per scene, as in the paper
    extruded: float | None = None  #: see `Scale.extruded_fraction`; None: the scale's
    paper_start: bool = False  #: as in the paper: no empty samples, no extruded textures, plain initial weights
    train_depth: tuple[Depth, ...] = ("true",)  #: depth of each stage of training
    test_depth: Depth = "estimated"  #: depth of P^-1 and of residual models in the test

    def __post_init__(self) -> None:
        if self.network is not None:
            one_of("network", self.network, VARIANTS)
        one_of("stream", self.stream, Stream)
        for depth in self.train_depth:
            one_of("train_depth", depth, Depth)
        one_of("test_depth", self.test_depth, ("true", "estimated"))

    @property
    def reads_depth(self) -> bool:
        """Whether depth is an input; if not, `train_depth` and `test_depth` have no effect."""
        return self.network is None or VARIANTS[self.network][1].get("residual", False)

    def stages(self, scale: Scale) -> tuple[Depth, ...]:
        """Depth of each stage of training; one stage if depth is no input, or of any quality."""
        if not self.reads_depth:
            return ("true",)
        return ("mixed",) if scale.mixed_depth else self.train_depth

    def texture(self, scale: Scale) -> TextureConfig:
        """Textures in training."""
        return replace(scale.texture, white_fraction=self.white_fraction, scales=self.scales or scale.texture.scales)

    def model(self, scale: Scale) -> ModelConfig:
        """Configuration of the network, before the changes of its variant."""
        model = replace(scale.model, measured=True) if scale.mixed_depth and self.reads_depth else scale.model
        if not self.paper_start:
            return model
        return replace(model, ground_start=False, zero_init_gain=1.0, residual_init_gain=1.0, foreground_prior=0.5)

    def extruded_fraction(self, scale: Scale) -> float:
        """Fraction of training samples with extruded textures."""
        if self.extruded is not None:
            return self.extruded
        return 0.0 if self.paper_start else scale.extruded_fraction

    def empty_fraction(self, scale: Scale) -> float:
        """Fraction of empty training samples; 0 for class masks, many of which are empty."""
        return 0.0 if self.paper_start or self.stream == "classes" else scale.empty_fraction


def _experiments() -> dict[str, Experiment]:
    stages: tuple[Depth, ...] = ("true", "estimated")
    rows = (
        # Table 1
        Experiment("a.1", None, test_depth="true"),
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
        Experiment("d.predicted", "d", train_depth=("estimated",)),
        # Table 4
        Experiment("c.10", white_fraction=0.10),
        Experiment("c.15", white_fraction=0.15),
        Experiment("c.25", white_fraction=0.25),
        Experiment("c.30", white_fraction=0.30),
        # Table 5
        Experiment("c.modsem", stream="modsem"),
        Experiment("c.depthproj", stream="depthproj"),
        # not in the paper: size of structures, extrusion, fresh textures; then the paper's choice of all three
        Experiment("c.fixed", scales=(1.0, 1.0)),
        Experiment("c.mesh", extruded=0.0),
        Experiment("c.once", fresh=False),
        Experiment("c.paper", scales=(1.0, 1.0), fresh=False, paper_start=True),
    )
    return {experiment.row: experiment for experiment in rows}


#: row -> run, by priority
EXPERIMENTS = _experiments()


def experiment(row: str) -> Experiment:
    """The run of a row. Raises `InputError` for an unknown row."""
    return EXPERIMENTS[one_of("row", row, EXPERIMENTS)]
