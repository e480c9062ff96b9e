"""Views -> samples (I_rgb, I_zero, M_zero, M_aux): the streams that networks are trained and tested on.

Batches are dicts of tensors (B samples, K modalities, H pixels and M cells per side): `rgb` (B, 3, H, H) uint8; `zero`
(B, K, H, H) and `target` (B, K, M, M) bool; `aux` (B, 2, M, M) bool, obstacles and navigable space; `fov` (B, 1, M, M)
bool; `depth` (B, 1, H, H) float32, metres; `scene` (B,) int64. They travel to worker processes and GPUs with a byte
per value; networks take them as `as_float` returns them.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import torch

from zerobev.common.errors import InputError
from zerobev.config import LABELS, CameraConfig
from zerobev.data.shards import Shard
from zerobev.data.textures import MODSEM_DRAWS, TextureBank, random_rectangles
from zerobev.data.views import View
from zerobev.geometry.cameras import Pose, bev_cell_centres
from zerobev.geometry.projection import inverse_project_mask, map_coordinates

Sample = dict[str, np.ndarray | np.int64]
#: The images of K modalities in FPV (K, H, H) and the same on the map (K, M, M), bool or float.
Pair = tuple[np.ndarray, np.ndarray]
#: Texels of 1 cm, as many as int16 has, after which a plan repeats; the world's origin is in the middle.
_PLAN_TEXELS = 2**15

_cell_centres = cache(bev_cell_centres)


class ViewSet:
    """The views of several shards under one index; of each shard the first `max_views`, or all."""

    def __init__(self, shards: list[Shard], max_views: int | None = None) -> None:
        self.shards = shards
        self._max_views = max_views
        self._start = np.cumsum(
            [0, *(len(shard) if max_views is None else min(len(shard), max_views) for shard in shards)]
        )
        self._depth: Sequence[np.ndarray] | None = None

    def __len__(self) -> int:
        return int(self._start[-1])

    def first(self, max_views: int | None) -> "ViewSet":
        """Of each shard the first `max_views` of these views, or all."""
        some = ViewSet(self.shards, self._max_views if max_views is None else max_views)
        some._depth = self._depth
        return some

    def with_depth(self, maps: Sequence[np.ndarray]) -> "ViewSet":
        """The same views with their depth replaced, by a predicted one say.

        maps: for each shard one array-like (V, H, H) of planar depth in metres, float16 or float32, which is read view
        by view (it may lie in a file). Arrays that do not fit the shards are an `InputError`.
        """
        expected = [len(shard) for shard in self.shards]
        found = [len(shard_maps) for shard_maps in maps]
        if found != expected:
            raise InputError(f"depth maps: expected {expected} views a shard, found {found}")
        changed = ViewSet(self.shards, self._max_views)
        changed._depth = maps
        return changed

    def locate(self, index: int) -> tuple[int, View]:
        """Number of the shard that holds view `index`, and the view."""
        shard = int(np.searchsorted(self._start, index, side="right")) - 1
        place = index - int(self._start[shard])
        view = self.shards[shard].view(place)
        if self._depth is None:
            return shard, view
        depth = np.asarray(self._depth[shard][place], np.float32)
        if depth.shape != view.depth.shape:
            raise InputError(f"depth maps: expected views of {view.depth.shape}, found {depth.shape}")
        return shard, replace(view, depth=depth)


class ViewSampler:
    """Which view the samples of a training take: each pass over them is in a new order, drawn from the seed."""

    def __init__(self, views: int, seed: int) -> None:
        self._views, self._seed = views, seed
        self._epoch = -1  # whose order is at hand

    def __getitem__(self, index: int) -> int:
        """The view of sample number `index`."""
        epoch, position = divmod(index, self._views)
        if self._epoch != epoch:
            self._epoch = epoch
            self._permutation = np.random.default_rng([self._seed, 0, epoch]).permutation(self._views)
        return int(self._permutation[position])


class SampleStream(ABC):
    """Endless training tuples, whatever their modality.

    Sample i is a function of (seed, i) alone: training may stop at any step and go on, or be spread over
    processes, and sees the same data. Each pass over the views is in a new random order.

    empty_fraction: fraction of the samples whose modality is made empty, in the image and on the map. Textures fill
        every view; the mask of a class is empty in most views, and all that is predicted for an empty image is error.
    """

    def __init__(
        self, views: ViewSet, camera: CameraConfig, seed: int, batch: int, empty_fraction: float = 0.0
    ) -> None:
        self._views = views
        self._camera = camera
        self._seed = seed
        self._batch = batch
        self._empty_fraction = empty_fraction
        self._order = ViewSampler(len(views), seed)

    @abstractmethod
    def pair(self, view: View, scene: int, rng: np.random.Generator) -> Pair:
        """The modality of `view`, a view of scene number `scene`; `rng` is that of the sample."""

    def batch(self, step: int, rank: int = 0, ranks: int = 1) -> dict[str, torch.Tensor]:
        """The batch of a training step; with several ranks each gets every `ranks`-th sample of it."""
        first = step * self._batch
        return collate([self.sample(i) for i in range(first + rank, first + self._batch, ranks)])

    def sample(self, index: int) -> Sample:
        """Tuple number `index`."""
        scene, view = self._views.locate(self._order[index])
        rng = np.random.default_rng([self._seed, 1, index])
        zero, target = self.pair(view, scene, rng)
        if rng.random() < self._empty_fraction:
            zero, target = np.zeros_like(zero), np.zeros_like(target)
        return view_sample(view, self._camera, scene, zero, target)


class SynthSamples(SampleStream):
    """*Synth* textures (paper, Section 3.2): a fresh one for every sample, or one a scene as in the paper.

    With `fresh=False` the texture of a scene, its scale included, is a function of (seed, scene), the same in all
    epochs. Scales are drawn between `bank.config.scales`.

    extruded_fraction: fraction of the samples (with `fresh=False`, of the scenes) whose texture is extruded: constant
        along the vertical on everything raised. If the mesh is painted all around, the map shows the upper side of a
        wall or a shelf, and the camera its front, whose texture is independent of it. Classes and most other
        modalities are constant along the vertical; from extruded samples the network learns the positions of raised
        surfaces.
    """

    def __init__(
        self,
        views: ViewSet,
        bank: TextureBank,
        camera: CameraConfig,
        seed: int,
        batch: int,
        empty_fraction: float = 0.0,
        fresh: bool = True,
        extruded_fraction: float = 0.0,
    ) -> None:
        super().__init__(views, camera, seed, batch, empty_fraction)
        self._bank = bank
        self._fresh = fresh
        self._extruded_fraction = extruded_fraction

    def pair(self, view: View, scene: int, rng: np.random.Generator) -> Pair:
        """The texture on the surfaces as both sensors see it."""
        shard = self._views.shards[scene]
        if not self._fresh:
            rng = np.random.default_rng([self._seed, 2, scene])
        draw = self._bank.draw(rng, shard.charts + 1)  # the last one is worn by what is painted from above
        texels = view.fpv_texel, view.bev_texel
        if rng.random() < self._extruded_fraction:
            texels = extruded_texels(view, self._camera, shard.charts)
        white = self._bank.look_up(np.concatenate([image.reshape(-1, 3) for image in texels]), draw)
        zero, target = np.split(white, [view.depth.size])
        return zero.reshape(1, *view.depth.shape), target.reshape(1, *view.fov.shape)


def extruded_texels(view: View, camera: CameraConfig, chart: int) -> tuple[np.ndarray, np.ndarray]:
    """The texels of a view, (H, H, 3) and (M, M, 3) int16, with one chart more: the plan, in centimetres of the world.

    It takes the place of all that is raised, so that a texture of it is the same all along the vertical. The image's
    surfaces above `max_height_m` stay what they are: below a ceiling is something else.
    """
    x, y, height = (of.numpy() for of in map_coordinates(torch.from_numpy(view.depth), camera))
    under_ceiling = np.where(height < camera.max_height_m, height, 0)
    images = (view.fpv_texel, x, y, under_ceiling), (view.bev_texel, *_cell_centres(camera), view.bev_height)
    # pixels and cells in one go: of images this small, half the time is the calls
    texel, x, y, height = (np.concatenate([of.reshape(-1, *of.shape[2:]) for of in both]) for both in zip(*images))
    raised = (texel[:, 0] >= 0) & (height > camera.obstacle_m)
    np.copyto(texel[:, 0], np.int16(chart), where=raised)
    for axis, (right, forward, _) in enumerate(Pose(*view.pose).world_R_map[:2]):
        plan = 100 * (x * right + y * forward + view.pose[axis]) + _PLAN_TEXELS / 2
        plan = np.floor(plan, out=plan).astype(np.int32) & (_PLAN_TEXELS - 1)
        np.copyto(texel[:, 1 + axis], plan.astype(np.int16), where=raised)
    fpv, bev = np.split(texel, [view.depth.size])
    return fpv.reshape(view.fpv_texel.shape), bev.reshape(view.bev_texel.shape)


class ModSemSamples(SampleStream):
    """*Mod. Sem.* textures (paper, Table 5 and supplement): eroded objects; a sample shows one of a scene's draws."""

    def pair(self, view: View, scene: int, rng: np.random.Generator) -> Pair:
        """One bit of the draws that were recorded with the view."""
        bit = np.uint8(1 << rng.integers(MODSEM_DRAWS))
        return view.fpv_modsem[None] & bit > 0, view.bev_modsem[None] & bit > 0


class DepthProjSamples(SampleStream):
    """*Depth proj.* (paper, Table 5 and supplement): random rectangles, projected with the depth of the view."""

    def pair(self, view: View, scene: int, rng: np.random.Generator) -> Pair:
        """Rectangles in the image, and the cells that a white pixel falls into."""
        zero = random_rectangles(view.depth.shape, rng)
        return zero[None], inverse_project_mask(zero, view.depth, self._camera)[None]


class SemanticSamples(SampleStream):
    """The eight classes as modalities (K = 8, in the order of `LABELS`): what TIM and VPN are trained on."""

    def pair(self, view: View, scene: int, rng: np.random.Generator) -> Pair:
        """The masks of the classes; nothing is random."""
        return class_masks(view, self._views.shards[scene].instance_label)


class SemanticPass:
    """All views once, in order, with the eight classes as modalities (K = 8, in the order of `LABELS`), in batches."""

    def __init__(self, views: ViewSet, camera: CameraConfig, batch: int) -> None:
        self._views, self._camera, self._batch = views, camera, batch

    def __len__(self) -> int:
        return -(-len(self._views) // self._batch)

    def batch(self, number: int, rank: int = 0, ranks: int = 1) -> dict[str, torch.Tensor]:
        """Batch `number`; the last one may be smaller. With several ranks each gets every `ranks`-th of its views."""
        last = min((number + 1) * self._batch, len(self._views))
        chosen = range(number * self._batch + rank, last, ranks)
        return collate([semantic_sample(self._views, i, self._camera) for i in chosen])


def semantic_batches(views: ViewSet, camera: CameraConfig, batch: int) -> Iterator[dict[str, torch.Tensor]]:
    """The batches of a `SemanticPass`, in order, as `as_float` returns them."""
    source = SemanticPass(views, camera, batch)
    for number in range(len(source)):
        yield as_float(source.batch(number))


def semantic_sample(views: ViewSet, index: int, camera: CameraConfig) -> Sample:
    """View number `index` with the masks of the eight classes in FPV and in BEV."""
    scene, view = views.locate(index)
    return view_sample(view, camera, scene, *class_masks(view, views.shards[scene].instance_label))


def class_masks(view: View, instance_label: np.ndarray) -> Pair:
    """The masks of the eight classes; `instance_label` (largest id + 1,) int8 is the label of each instance id."""
    classes = np.arange(len(LABELS), dtype=np.int8)[:, None, None]
    return instance_label[view.fpv_instance] == classes, instance_label[view.bev_instance] == classes


def view_sample(view: View, camera: CameraConfig, scene: int, zero: np.ndarray, target: np.ndarray) -> Sample:
    """What every stream takes from a view, around the modality images `zero` (K, H, H) and `target` (K, M, M)."""
    surface = view.bev_texel[..., 0] >= 0
    obstacle = surface & (view.bev_height > camera.obstacle_m)
    return {
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
