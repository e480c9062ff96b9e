"""Random changes of training samples: looks, cameras, mirroring."""

import numpy as np

from zerobev.config import AugmentConfig, CameraConfig
from zerobev.data.coverage import other_camera
from zerobev.data.looks import new_look
from zerobev.data.samples import Sample
from zerobev.data.textures import TextureBank
from zerobev.data.views import View
from zerobev.geometry.projection import fov_mask

_IMAGES = ("rgb", "zero", "depth", "target", "aux", "fov")


class Augmentation:
    """The changes of `config`, each in a fraction of the samples; an `Augment` of `data.samples`."""

    def __init__(self, config: AugmentConfig, camera: CameraConfig, bank: TextureBank) -> None:
        self._config, self._camera, self._bank = config, camera, bank

    def __call__(self, sample: Sample, view: View, charts: int, rng: np.random.Generator) -> Sample:
        """The changed sample; `sample` stays as it is."""
        fractions = (self._config.looks, self._config.cameras, self._config.mirrored)
        looks, cameras, mirrored = rng.random(3) < fractions
        sample = dict(sample)
        if looks:
            sample["rgb"] = np.moveaxis(new_look(view, self._bank, charts, self._camera, rng), -1, 0)
        if cameras:
            sample |= self._from_other_camera(sample, view, rng)
        if mirrored:
            sample |= {
                name: np.ascontiguousarray(np.asarray(sample[name])[..., ::-1]) for name in _IMAGES if name in sample
            }
        return sample

    def _from_other_camera(self, sample: Sample, view: View, rng: np.random.Generator) -> Sample:
        stretch = 1.0 if view.height_m is None else view.height_m / self._camera.height_m
        covered, nearest = other_camera(self._camera, stretch, rng)
        depth = np.where(covered, view.depth, np.float32(0))
        changed: Sample = {
            "rgb": np.asarray(sample["rgb"]).reshape(3, -1)[:, nearest],
            "depth": np.where(covered, sample["depth"], np.float32(0)),
        }
        if "zero" in sample:
            changed |= {"zero": sample["zero"] & covered}
            changed |= {"fov": sample["fov"] & fov_mask(depth, view.seen_by(self._camera))}
        return changed
