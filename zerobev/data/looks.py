"""New looks of a photograph: other colours and patterns on surfaces, other light, and the effects of cameras.

Networks for geometry learn the look of their training homes: their colours, light and sharpness. The G-buffer gives
each pixel its instance and texel, so a photograph gets new colours and patterns by look-up, as the zero-shot image
does.
"""

import io
from functools import cache

import numpy as np
from PIL import Image
from scipy import ndimage

from zerobev.config import CameraConfig
from zerobev.data.textures import TextureBank
from zerobev.data.views import View
from zerobev.geometry.cameras import column_slopes

# probabilities of each change in a sample with a new look
_RECOLORED, _PATTERNED, _RELIT, _BLURRED, _COMPRESSED = 0.6, 0.6, 0.6, 0.4, 0.4
_NOISE_PX = 1024  # side of the table of noise; images are smaller
_STEPS = 2048  # of a table of brightness
_LINEAR = (np.arange(256, dtype=np.float32) / 255) ** 2  # sRGB to light, approximately


def new_look(view: View, bank: TextureBank, charts: int, camera: CameraConfig, rng: np.random.Generator) -> np.ndarray:
    """The photograph of a view, (H, W, 3) uint8, with a new look.

    bank: of the patterns
    charts: number of charts of the scene
    """
    light = _LINEAR[view.rgb]
    if rng.random() < _RECOLORED:
        light *= _colors(view.fpv_instance, rng)
    if rng.random() < _PATTERNED:
        light *= _patterns(view, bank, charts, rng)
    if rng.random() < _RELIT:
        light *= _illumination(view.depth, camera, rng)[..., None]
    return _photographed(light, rng)


def _colors(instance: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(H, W, 3) float32: a factor per instance on its colour."""
    count = int(instance.max()) + 1
    brightness, tint = rng.normal(0, 0.5, (count, 1)), rng.normal(0, 0.25, (count, 3))
    return np.exp(brightness + tint).astype(np.float32)[instance]


def _patterns(view: View, bank: TextureBank, charts: int, rng: np.random.Generator) -> np.ndarray:
    """(H, W, 3) float32: a factor in the white parts of a random texture, on half of the instances."""
    white = bank.look_up(view.fpv_texel, bank.draw(rng, charts))
    count = int(view.fpv_instance.max()) + 1
    contrast = rng.normal(0, 0.6, (count, 1)) + rng.normal(0, 0.15, (count, 3))
    factor = np.exp(contrast * (rng.random((count, 1)) < 0.5)).astype(np.float32)
    return np.where(white[..., None], factor[view.fpv_instance], np.float32(1))


def _illumination(depth: np.ndarray, camera: CameraConfig, rng: np.random.Generator) -> np.ndarray:
    """(H, W) float32: light that falls off with the distance from a lamp at a random place."""
    slopes = column_slopes(camera.fpv_px, camera.focal_px).astype(np.float32)
    right, down, forward = rng.uniform((-3, -1.5, -0.5), (3, 0.8, 5)).astype(np.float32)
    squared = (slopes * depth - right) ** 2 + (slopes[:, None] * depth - down) ** 2 + (depth - forward) ** 2
    light = 1 / (squared + np.float32(rng.uniform(0.5, 4)))
    ambient = np.float32(rng.uniform(0.1, 0.8))
    return ambient + (1 - ambient) / light.mean() * light


@cache
def _noise() -> np.ndarray:
    """(S, S, 3) float32 normal numbers; a new image takes them from a random place."""
    return np.random.default_rng(0).standard_normal((_NOISE_PX, _NOISE_PX, 3), np.float32)


def _photographed(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(H, W, 3) uint8: light through a camera with its exposure, colours, sharpness, noise and compression."""
    side = light.shape[0]
    if rng.random() < _BLURRED:
        sigma = rng.uniform(0, 0.012) * side
        light = ndimage.gaussian_filter(light, (sigma, sigma, 0), truncate=2.0)
    exposure = np.exp(rng.normal(0, 0.45) + rng.normal(0, 0.1, 3))
    curve = np.linspace(0, 1, _STEPS, dtype=np.float32) ** np.float32(0.5 * np.exp(rng.normal(0, 0.2)))
    level = curve[np.clip(light * ((_STEPS - 1) * exposure.astype(np.float32)), 0, _STEPS - 1).astype(np.int32)]
    grey = level.mean(axis=2, keepdims=True)
    level = grey + np.float32(rng.uniform(0.2, 1.3)) * (level - grey)
    level = 0.5 + np.float32(np.exp(rng.normal(0, 0.2))) * (level - 0.5)
    across = np.linspace(-1, 1, side, dtype=np.float32) ** 2
    level *= 1 - np.float32(rng.uniform(0, 0.25)) * (across[:, None] + across)[..., None]
    top, left = rng.integers(0, _NOISE_PX - side, 2)
    level += np.float32(abs(rng.normal(0, 0.025))) * _noise()[top : top + side, left : left + side]
    rgb = np.rint(255 * np.clip(level, 0, 1)).astype(np.uint8)
    if rng.random() < _COMPRESSED:
        file = io.BytesIO()
        Image.fromarray(rgb).save(file, "JPEG", quality=int(rng.integers(30, 95)))
        rgb = np.asarray(Image.open(file))
    return rgb
