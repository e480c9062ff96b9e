"""All settings, as frozen dataclasses, and the scales.

Code and notebooks are the same at every scale. Values that a scale does not set (field of view, map extent, alpha,
batch of 16, ...) are the paper's.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from zerobev.common.errors import InputError

Split = Literal["train", "validation", "test"]
#: Training data of the zero-shot stream; "classes" is not zero-shot (paper, Table 5 and Section 4).
Stream = Literal["synth", "modsem", "depthproj", "classes"]
#: Depth input of a method; "mixed", in training alone, is of any quality, see `data.sensor_depth.mixed_depth`.
Depth = Literal["true", "estimated", "mixed"]
#: Generated homes: flats like each other, or a mixture of buildings, styles and light.
Homes = Literal["flats", "varied"]
#: Residual block of the RGB backbone.
Block = Literal["basic", "bottleneck"]

SPLITS: tuple[Split, ...] = get_args(Split)

#: The eight evaluated classes, in the column order of the paper's tables.
LABELS = ("wall", "floor", "chair", "sofa", "bed", "plant", "toilet", "tv")
#: Label of everything outside the eight classes.
NO_LABEL = -1
#: The auxiliary maps, in the order of their channels in a batch.
AUX = ("obstacles", "navigable")


def one_of(argument: str, value: Any, choices: Any) -> Any:
    """`value` if it is among `choices` (a `Literal` or a collection of names); else raises `InputError`."""
    names = get_args(choices) or tuple(choices)
    if value not in names:
        raise InputError(f"{argument}: expected one of {', '.join(names)}, found {value!r}")
    return value


def _require(name: str, value: float, holds: bool, expected: str) -> None:
    if not holds:
        raise InputError(f"{name}: expected {expected}, found {value:g}")


@dataclass(frozen=True)
class CameraConfig:
    """The pinhole FPV camera and the orthographic BEV map in front of it (paper, supplement, "Cameras").

    The map has row 0 farthest, column 0 leftmost, and the camera at the middle of its lower edge.
    """

    fpv_px: int  #: side of the square FPV image
    bev_px: int  #: cells per side of the square map
    hfov_deg: float = 79.0
    height_m: float = 0.88  #: of the pinhole above the floor
    bev_extent_m: float = 5.0  #: side of the map
    bev_above_m: float = 2.0  #: height of the orthographic camera above the pinhole
    max_height_m: float = 2.0  #: above the floor; the map leaves out higher points
    obstacle_m: float = 0.10  #: higher cells are obstacles, the others navigable

    def __post_init__(self) -> None:
        _require("fpv_px", self.fpv_px, self.fpv_px >= 1, "1 or more")
        _require("bev_px", self.bev_px, self.bev_px >= 1, "1 or more")
        _require("hfov_deg", self.hfov_deg, 0 < self.hfov_deg < 180, "more than 0 and less than 180")
        _require("bev_extent_m", self.bev_extent_m, self.bev_extent_m > 0, "more than 0")

    @property
    def focal_px(self) -> float:
        """Focal length of the FPV image, pixels."""
        return 0.5 * self.fpv_px / math.tan(math.radians(self.hfov_deg) / 2)

    def at_height(self, height_m: float) -> "CameraConfig":
        """The camera for images from another height, stretched vertically to this camera's floor.

        In such an image the floor is at this camera's rows. Heights above the floor appear scaled by the ratio of the
        two camera heights, and so do the limits on them.
        """
        factor = self.height_m / height_m
        return replace(self, max_height_m=factor * self.max_height_m, obstacle_m=factor * self.obstacle_m)

    @property
    def cell_m(self) -> float:
        """Side of a map cell, metres."""
        return self.bev_extent_m / self.bev_px

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """`extent` for `imshow` of a map: metres to the right of the camera and in front of it."""
        half = self.bev_extent_m / 2
        return (-half, half, 0.0, self.bev_extent_m)


@dataclass(frozen=True)
class AgentConfig:
    """The body that carries the camera, and the choice of its poses (Habitat's ObjectNav agent)."""

    radius_m: float = 0.18
    height_m: float = 1.5
    climb_m: float = 0.2  #: geometry up to this height above the floor does not block
    grid_m: float = 0.05  #: side of a cell of the navigability grid
    island_m2: float = 0.5  #: smaller patches of free floor (for example inside furniture) are not navigable
    min_view: float = 0.10  #: minimum fraction of the map in view; poses that face a wall see less


@dataclass(frozen=True)
class TextureConfig:
    """The *Synth* textures (paper, supplement, "Synth."); one texel is 1 cm in generated homes."""

    white_fraction: float = 0.20  #: of white texels in the finished texture
    opened_fraction: float = 0.05  #: of white texels before dilation starts
    kernel_px: tuple[int, int] = (10, 30)  #: smallest and largest kernel of opening and dilation
    tile_px: int = 1024  #: side of a tile of the texture bank
    tiles: int = 32  #: number of tiles in the bank
    #: range of the factor by which structures shrink (below 1: grow), drawn log-uniformly per sample; the paper's is 1
    scales: tuple[float, float] = (1.0, 1.0)
    modsem_fraction: float = 0.30  #: of white texels in *Mod. Sem.* textures


@dataclass(frozen=True)
class AugmentConfig:
    """Random changes of training samples (not in the paper); fractions of the samples."""

    looks: float = 0.0  #: with another look of the photograph, see `data.looks`
    cameras: float = 0.0  #: as seen by a tilted camera, or one with another field of view, see `data.coverage`
    mirrored: float = 0.0  #: mirrored left to right


@dataclass(frozen=True)
class SceneConfig:
    """Number of scenes per split, number of views per scene, and the seed of both."""

    train: int
    validation: int
    test: int
    views: int  #: per scene
    seed: int = 0
    homes: Homes = "flats"  #: kind of generated homes
    #: range of the camera's height above the floor, drawn per view; None: that of `CameraConfig`
    heights_m: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        one_of("homes", self.homes, Homes)


@dataclass(frozen=True)
class ModelConfig:
    """Sizes of the network (paper, supplement, "Architecture Details")."""

    width: int  #: channels of the pyramid, the transformers and the BEV features
    block: Block  #: residual block of the RGB backbone
    depths: tuple[int, ...]  #: residual blocks in each stage of the RGB backbone
    channels: tuple[int, ...]  #: output channels of each stage
    stem_channels: int
    stem_stride: int  #: 2 or 4; stage b has stride stem_stride * 2**b
    zero_channels: tuple[int, int, int, int]  #: of the small CNN of the zero-shot stream
    ffn: tuple[int, int, int, int]  #: hidden width of the feed-forward layers per band, near band first
    decoder_channels: tuple[int, int, int]  #: ResNet stages of the BEV decoder
    vpn_depths: tuple[int, int, int]  #: residual blocks, "basic", in each stage of VPN's smaller backbone
    vpn_channels: tuple[int, int, int]  #: output channels of these stages
    heads: int = 4
    layers: int = 2  #: of the column encoder, and of the ray decoder
    dropout: float = 0.1
    ground_start: bool = False  #: initial attention of rays is on the image row of the floor (not in the paper)
    zero_init_gain: float = 1.0  #: factor on the initial weights of the zero-shot stream's CNN
    residual_init_gain: float = 1.0  #: factor on the initial weights of the residual's embedding
    foreground_prior: float = 0.5  #: initial probability of white in maps
    band_edges_m: tuple[float, ...] = (0.0, 0.8, 2.0, 3.8, 5.0)  #: depths between bands
    aux: tuple[str, ...] = AUX  #: auxiliary maps predicted beside the zero-shot map, in the order of `AUX`
    residual: bool = False  #: add P^-1 of the zero-shot image to the map features (Zero-BEV, rows (d))
    seen: bool = False  #: beside that, which cells P^-1 sees at all
    measured: bool = False  #: and which of them by measured depth, see `models.base.BevModel`
    floor_depth: bool = False  #: estimated depth is at most that of the floor
    own_rays: bool = False  #: the depth estimator reads the rays of the image's own camera, from its height
    segmentation: bool = False  #: masks of the eight classes as input (TIM, row (b.3))


@dataclass(frozen=True)
class TrainConfig:
    """Optimisation with Adam (paper, "Implementation and training details")."""

    steps: int
    learning_rate: float
    decay_every: int  #: steps between two multiplications of the learning rate by `decay`
    validate_every: int  #: steps
    warmup: int = 0  #: steps of linear warm-up
    decay: float = 0.9
    patience: int = 3  #: validations without progress before the learning rate is halved
    batch: int = 16
    alpha: float = 0.5  #: weight of the auxiliary loss
    weight_decay: float = 0.0

    def __post_init__(self) -> None:
        for name in ("steps", "decay_every", "validate_every", "batch"):
            _require(name, getattr(self, name), getattr(self, name) >= 1, "1 or more")
        _require("learning_rate", self.learning_rate, self.learning_rate > 0, "more than 0")
        _require("decay", self.decay, 0 < self.decay <= 1, "more than 0 and at most 1")
        _require("alpha", self.alpha, 0 <= self.alpha <= 1, "a value from 0 to 1")


@dataclass(frozen=True)
class Scale:
    """A complete configuration."""

    name: str
    camera: CameraConfig
    scenes: SceneConfig
    model: ModelConfig
    train: TrainConfig
    depth: TrainConfig  #: of the depth estimator
    texture: TextureConfig = field(default_factory=TextureConfig)
    empty_fraction: float = 0.0  #: fraction of empty samples (not in the paper)
    extruded_fraction: float = 0.0  #: fraction of *Synth* samples with extruded textures (not in the paper)
    objects_fraction: float = 0.0  #: fraction of *Synth* samples with whole instances in white (not in the paper)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    relative_depth: bool = False  #: the depth estimator's loss is the relative error (not in the paper)
    #: residual networks start from (c), train with depth of any quality, and know which is measured (not in the paper)
    mixed_depth: bool = False
    test_views: int | None = None  #: networks are evaluated on the first so many of each test scene; None: all
    #: initial weights of the RGB backbones, for `load_backbone`; empty: the depth estimator's
    backbone: str = ""
    vpn_backbone: str = ""


_REDUCED = Scale(
    name="reduced",
    camera=CameraConfig(fpv_px=64, bev_px=40),
    scenes=SceneConfig(train=200, validation=4, test=32, views=80),
    model=ModelConfig(
        width=32,
        block="basic",
        depths=(1, 2, 2, 2),
        channels=(16, 32, 64, 128),
        stem_channels=16,
        stem_stride=2,
        zero_channels=(16, 32, 32, 32),
        ffn=(64, 64, 64, 64),
        decoder_channels=(32, 48, 64),
        vpn_depths=(1, 2, 2),
        vpn_channels=(16, 32, 64),
        heads=2,
        layers=1,
        dropout=0.0,
        ground_start=True,
        zero_init_gain=4.0,
        residual_init_gain=6.0,
        foreground_prior=0.1,
    ),
    train=TrainConfig(steps=600, learning_rate=2e-3, decay_every=25, decay=0.85, validate_every=100, warmup=30),
    depth=TrainConfig(steps=8000, learning_rate=4e-3, decay_every=220, validate_every=1000, warmup=50),
    texture=TextureConfig(scales=(0.5, 1.0)),
    empty_fraction=0.2,
    extruded_fraction=0.75,
    test_views=24,
)
_LARGER = replace(_REDUCED.model, channels=(32, 64, 128, 256), stem_channels=32, stem_stride=4)
#: Weights for other people's images: more pixels, homes that are less alike, any camera, depth of any quality. The
#: strides are the paper's; they save as much time as the wider backbone takes.
_DEPLOY = replace(
    _REDUCED,
    name="deploy",
    camera=CameraConfig(fpv_px=128, bev_px=40),
    scenes=SceneConfig(train=200, validation=4, test=16, views=60, homes="varied", heights_m=(0.3, 1.8)),
    model=replace(_LARGER, seen=True, floor_depth=True, own_rays=True),
    train=TrainConfig(steps=10_000, learning_rate=1e-3, decay_every=250, decay=0.9, validate_every=1000, warmup=100),
    depth=TrainConfig(steps=20_000, learning_rate=4e-3, decay_every=500, decay=0.9, validate_every=2000, warmup=100),
    objects_fraction=0.5,
    augment=AugmentConfig(looks=0.9, cameras=0.3, mirrored=0.5),
    relative_depth=True,
    mixed_depth=True,
)

SCALES = {
    scale.name: scale
    for scale in (
        Scale(
            name="smoke",
            camera=CameraConfig(fpv_px=32, bev_px=20),
            scenes=SceneConfig(train=4, validation=1, test=2, views=8),
            model=ModelConfig(
                width=16,
                block="basic",
                depths=(1, 1, 1, 1),
                channels=(16, 16, 32, 32),
                stem_channels=16,
                stem_stride=2,
                zero_channels=(8, 8, 16, 16),
                ffn=(32, 32, 32, 32),
                decoder_channels=(16, 32, 32),
                vpn_depths=(1, 1, 1),
                vpn_channels=(16, 16, 32),
                dropout=0.0,
            ),
            train=TrainConfig(steps=240, learning_rate=1e-3, decay_every=80, validate_every=80, warmup=20),
            depth=TrainConfig(steps=120, learning_rate=3e-3, decay_every=12, decay=0.75, validate_every=40, warmup=10),
            texture=TextureConfig(tiles=8, tile_px=512),
        ),
        _REDUCED,
        _DEPLOY,
        Scale(
            name="paper",
            camera=CameraConfig(fpv_px=384, bev_px=100),
            scenes=SceneConfig(train=145, validation=4, test=32, views=2000),
            model=ModelConfig(
                width=256,
                block="bottleneck",
                depths=(3, 4, 6, 3),
                channels=(256, 512, 1024, 2048),
                stem_channels=64,
                stem_stride=4,
                zero_channels=(16, 32, 64, 64),
                ffn=(128, 128, 512, 512),
                decoder_channels=(64, 128, 256),
                vpn_depths=(2, 2, 2),
                vpn_channels=(64, 128, 256),
            ),
            # an epoch has 18,125 steps; 20 epochs and a decay per epoch are ours, since the paper gives neither
            train=TrainConfig(steps=18_125 * 20, learning_rate=1e-4, decay_every=18_125, validate_every=18_125),
            depth=TrainConfig(
                steps=30_625 * 20,
                learning_rate=1e-5,
                decay_every=30_625,
                validate_every=30_625,
                batch=32,
                weight_decay=2e-6,
            ),
            texture=TextureConfig(tiles=256, tile_px=2048),
            backbone="microsoft/resnet-50",
            vpn_backbone="microsoft/resnet-18",
        ),
    )
}


def scale(name: str) -> Scale:
    """The scale called `name`. Raises `InputError` for an unknown name."""
    return SCALES[one_of("scale", name, SCALES)]
