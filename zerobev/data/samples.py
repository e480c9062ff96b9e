"""Views -> samples (I_rgb, I_zero, M_zero, M_aux): the streams for training and evaluation.

Batches are dicts of tensors (B samples, K modalities, H pixels and M cells per side): `rgb` (B, 3, H, H) uint8; `zero`
(B, K, H, H) and `target` (B, K, M, M) bool; `aux` (B, 2, M, M) bool, obstacles and navigable space; `fov` (B, 1, M, M)
bool; `depth` (B, 1, H, H) float32, metres, or of any quality (B, 2, H, H), see `sensor_depth.mixed_depth`; `scene` (B,)
int64. Images and masks are sent to processes and GPUs with one byte per value; networks take the result of `as_float`.
If views are from different heights, batches have `height` (B,) float32, metres.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache

import numpy as np
import torch

from zerobev.config import LABELS, CameraConfig
from zerobev.data.sensor_depth import mixed_depth
from zerobev.data.textures import MODSEM_DRAWS, TextureBank, random_rectangles
from zerobev.data.view_set import ViewSampler, ViewSet
from zerobev.data.views import View
from zerobev.data.visibility import VISIBILITY
from zerobev.geometry.cameras import Pose, bev_cell_centres
from zerobev.geometry.projection import inverse_project_mask, map_coordinates

Sample = dict[str, np.ndarray | np.generic]
#: K modalities in the image (K, H, H) and on the map (K, M, M), bool or float.
Pair = tuple[np.ndarray, np.ndarray]
#: Period of the top view in texels of 1 cm, the largest for int16; the world's origin is in the middle.
_TOP_VIEW_TEXELS = 2**15

#: Smallest and largest fraction of the instances in white.
_OBJECTS = (0.03, 0.4)

#: Changes a sample of a view of a scene with so many charts.
Augment = Callable[[Sample, View, int, np.random.Generator], Sample]

_cell_centres = cache(bev_cell_centres)


class SampleStream(ABC):
    """Endless training samples of one modality.

    Sample i is a function of (seed, i) alone, so that the data are the same if training is interrupted or distributed
    over processes. Each epoch is in a new random order.

    empty_fraction: fraction of the samples with an empty modality, in the image and on the map. Textures fill every
        view, but the mask of a class is empty in most views, and the map of an empty image is empty.
    augment: changes each sample at random
    """

    def __init__(
        self,
        views: ViewSet,
        camera: CameraConfig,
        seed: int,
        batch: int,
        empty_fraction: float = 0.0,
        augment: Augment | None = None,
    ) -> None:
        self._views = views
        self._camera = camera
        self._seed = seed
        self._batch = batch
        self._empty_fraction = empty_fraction
        self._augment = augment
        self._order = ViewSampler(len(views), seed)

    @abstractmethod
    def pair(self, view: View, scene: int, rng: np.random.Generator) -> Pair:
        """The modality of `view` in scene number `scene`; `rng` is the sample's generator."""

    def batch(self, step: int, rank: int = 0, world_size: int = 1) -> dict[str, torch.Tensor]:
        """The batch of a training step; each of several ranks gets every `world_size`-th sample of it."""
        first = step * self._batch
        return collate([self.sample(i) for i in range(first + rank, first + self._batch, world_size)])

    def sample(self, index: int) -> Sample:
        """Sample `index`."""
        number = self._order[index]
        scene, view = self._views.locate(number)
        rng = np.random.default_rng([self._seed, 1, index])
        zero, target = self.pair(view, scene, rng)
        if rng.random() < self._empty_fraction:
            zero, target = np.zeros_like(zero), np.zeros_like(target)
        sample = view_sample(view, self._camera, scene, zero, target)
        estimate = self._views.estimate(number)
        if estimate is not None:
            sample["depth"] = mixed_depth(view.depth, estimate, view.rgb, rng)
        return self._augment(sample, view, self._views.shards[scene].charts, rng) if self._augment else sample


class SynthSamples(SampleStream):
    """*Synth* textures (paper, Section 3.2): a new one per sample, or one per scene as in the paper.

    With `fresh=False` the texture of a scene, including its scale, is a function of (seed, scene), the same in all
    epochs. Scales are drawn between `bank.config.scales`.

    extruded_fraction: fraction of the samples (with `fresh=False`, of the scenes) with an extruded texture: constant
        along the vertical on raised surfaces. Without extrusion the map shows the texture of the upper side of a wall
        or a shelf and the camera that of its front, which is independent of it. Classes and most other modalities are
        constant along the vertical; the network learns the positions of raised surfaces from extruded samples.
    objects_fraction: fraction of the samples with a random set of whole instances in white, drawn per sample; nothing
        in the photograph predicts the set
    """

    def __init__(
        self,
        views: ViewSet,
        bank: TextureBank,
        camera: CameraConfig,
        seed: int,
        batch: int,
        empty_fraction: float = 0.0,
        augment: Augment | None = None,
        fresh: bool = True,
        extruded_fraction: float = 0.0,
        objects_fraction: float = 0.0,
    ) -> None:
        super().__init__(views, camera, seed, batch, empty_fraction, augment)
        self._objects_fraction = objects_fraction
        self._bank = bank
        self._fresh = fresh
        self._extruded_fraction = extruded_fraction

    def pair(self, view: View, scene: int, rng: np.random.Generator) -> Pair:
        """The texture on the surfaces, in the image and on the map."""
        shard = self._views.shards[scene]
        if self._objects_fraction and rng.random() < self._objects_fraction:
            white = rng.random(len(shard.instance_label)) < rng.uniform(*_OBJECTS)
            white[0] = False  # unknown, or no surface
            return white[view.fpv_instance][None], white[view.bev_instance][None]
        if not self._fresh:
            rng = np.random.default_rng([self._seed, 2, scene])
        draw = self._bank.draw(rng, shard.charts + 1)  # the last one is for extruded surfaces
        texels = view.fpv_texel, view.bev_texel
        if rng.random() < self._extruded_fraction:
            texels = extruded_texels(view, self._camera, shard.charts)
        white = self._bank.look_up(np.concatenate([image.reshape(-1, 3) for image in texels]), draw)
        zero, target = np.split(white, [view.depth.size])
        return zero.reshape(1, *view.depth.shape), target.reshape(1, *view.fov.shape)


def extruded_texels(view: View, camera: CameraConfig, chart: int) -> tuple[np.ndarray, np.ndarray]:
    """The texels of a view, (H, H, 3) and (M, M, 3) int16, with raised surfaces on one more chart, the top view.

    Row and column on that chart are world coordinates in centimetres, so that its texture is constant along the
    vertical. In the image, surfaces above `max_height_m` keep their texels: the map does not show them.
    """
    x, y, height = (of.numpy() for of in map_coordinates(torch.from_numpy(view.depth), camera))
    if view.height_m is not None:
        height = height * np.float32(view.height_m / camera.height_m)
    under_ceiling = np.where(height < camera.max_height_m, height, 0)
    images = (view.fpv_texel, x, y, under_ceiling), (view.bev_texel, *_cell_centres(camera), view.bev_height)
    # pixels and cells together: for small images half the time is call overhead
    texel, x, y, height = (np.concatenate([of.reshape(-1, *of.shape[2:]) for of in both]) for both in zip(*images))
    raised = (texel[:, 0] >= 0) & (height > camera.obstacle_m)
    np.copyto(texel[:, 0], np.int16(chart), where=raised)
    for axis, (right, forward, _) in enumerate(Pose(*view.pose).world_R_map[:2]):
        world_cm = 100 * (x * right + y * forward + view.pose[axis]) + _TOP_VIEW_TEXELS / 2
        world_cm = np.floor(world_cm, out=world_cm).astype(np.int32) & (_TOP_VIEW_TEXELS - 1)
        np.copyto(texel[:, 1 + axis], world_cm.astype(np.int16), where=raised)
    fpv, bev = np.split(texel, [view.depth.size])
    return fpv.reshape(view.fpv_texel.shape), bev.reshape(view.bev_texel.shape)


class ModSemSamples(SampleStream):
    """*Mod. Sem.* textures (paper, Table 5 and supplement): eroded objects; one of the scene's draws per sample."""

    def pair(self, view: View, scene: int, rng: np.random.Generator) -> Pair:
        """One of the draws recorded with the view."""
        bit = np.uint8(1 << rng.integers(MODSEM_DRAWS))
        return view.fpv_modsem[None] & bit > 0, view.bev_modsem[None] & bit > 0


class DepthProjSamples(SampleStream):
    """*Depth proj.* (paper, Table 5 and supplement): random rectangles and their inverse projection."""

    def pair(self, view: View, scene: int, rng: np.random.Generator) -> Pair:
        """Rectangles in the image, and the map cells of their pixels."""
        zero = random_rectangles(view.depth.shape, rng)
        return zero[None], inverse_project_mask(zero, view.depth, view.seen_by(self._camera))[None]


class SemanticSamples(SampleStream):
    """The eight classes as modalities (K = 8, in the order of `LABELS`), for the training of TIM and VPN."""

    def pair(self, view: View, scene: int, rng: np.random.Generator) -> Pair:
        """The masks of the classes; `rng` is not used."""
        return class_masks(view, self._views.shards[scene].instance_label)


class SemanticPass:
    """All views once, in order, with the eight classes as modalities (K = 8, in the order of `LABELS`), in batches.

    visibility: `Workspace.visibility` of the views' scenes; batches then have `visibility` (B, 3, M, M) bool, the parts
        of the map in the order of `data.visibility.VISIBILITY`
    """

    def __init__(
        self, views: ViewSet, camera: CameraConfig, batch: int, visibility: Sequence[np.ndarray] | None = None
    ) -> None:
        self._views, self._camera, self._batch, self._visibility = views, camera, batch, visibility

    def __len__(self) -> int:
        return -(-len(self._views) // self._batch)

    def batch(self, number: int, rank: int = 0, world_size: int = 1) -> dict[str, torch.Tensor]:
        """Batch `number`; the last may be smaller. Each of several ranks gets every `world_size`-th of its views."""
        last = min((number + 1) * self._batch, len(self._views))
        chosen = range(number * self._batch + rank, last, world_size)
        return collate([self._sample(i) for i in chosen])

    def _sample(self, index: int) -> Sample:
        sample = semantic_sample(self._views, index, self._camera)
        if self._visibility is None:
            return sample
        scene, number = self._views.place(index)
        parts = np.arange(len(VISIBILITY))[:, None, None]
        return sample | {"visibility": self._visibility[scene][number] == parts}


def semantic_batches(views: ViewSet, camera: CameraConfig, batch: int) -> Iterator[dict[str, torch.Tensor]]:
    """The batches of a `SemanticPass`, in order, with the types of `as_float`."""
    source = SemanticPass(views, camera, batch)
    for number in range(len(source)):
        yield as_float(source.batch(number))


def semantic_sample(views: ViewSet, index: int, camera: CameraConfig) -> Sample:
    """View `index` with the masks of the eight classes in FPV and in BEV."""
    scene, view = views.locate(index)
    return view_sample(view, camera, scene, *class_masks(view, views.shards[scene].instance_label))


def class_masks(view: View, instance_label: np.ndarray) -> Pair:
    """The masks of the eight classes; `instance_label` (largest id + 1,) int8 is the label of each instance id."""
    classes = np.arange(len(LABELS), dtype=np.int8)[:, None, None]
    return instance_label[view.fpv_instance] == classes, instance_label[view.bev_instance] == classes


def view_sample(view: View, camera: CameraConfig, scene: int, zero: np.ndarray, target: np.ndarray) -> Sample:
    """A sample of a view and its modality in the image, `zero` (K, H, H), and on the map, `target` (K, M, M)."""
    surface = view.bev_texel[..., 0] >= 0
    obstacle = surface & (view.bev_height > camera.obstacle_m)
    height: Sample = {} if view.height_m is None else {"height": np.float32(view.height_m)}
    return height | {
        "rgb": np.moveaxis(view.rgb, -1, 0),
        "depth": view.depth[None].astype(np.float32),
        "zero": zero,
        "target": target,
        "aux": np.stack([obstacle, surface & ~obstacle]),
        "fov": view.fov[None],
        "scene": np.int64(scene),
    }


def collate(samples: list[Sample]) -> dict[str, torch.Tensor]:
    """Stack samples into a batch."""
    return {name: torch.from_numpy(np.stack([sample[name] for sample in samples])) for name in samples[0]}


def as_float(batch: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The batch with masks as float32 in {0, 1} and images as float32 in [0, 1], on its device."""
    return {
        name: value.float() / 255
        if value.dtype == torch.uint8
        else value.float()
        if value.dtype == torch.bool
        else value
        for name, value in batch.items()
    }
