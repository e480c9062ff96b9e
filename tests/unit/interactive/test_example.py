"""The shipped example is a view of a generated home."""

from dataclasses import replace

import numpy as np
import pytest

from zerobev.config import SCALES, TextureConfig
from zerobev.data.views import ViewSource
from zerobev.interactive.example import FOLDER, example
from zerobev.scenes.indoor import generate_home

SEED, DRAW = 105, 7


def drawn() -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Image, numbers of objects and names, rendered again; numbers are in the order of the home's instances."""
    scene = generate_home("example", np.random.default_rng(SEED))
    camera = replace(SCALES["reduced"].camera, fpv_px=256)
    source = ViewSource(scene, camera, TextureConfig(), np.random.default_rng(0))
    view = [source.draw() for _ in range(DRAW + 1)][-1]
    present, numbers = np.unique(view.fpv_instance, return_inverse=True)
    names = {instance.id: instance.name for instance in scene.instances}
    return view.rgb, numbers.reshape(view.fpv_instance.shape), [names[number] for number in present.tolist()]


@pytest.mark.slow
def test_the_example_is_a_view_of_a_generated_home():
    (rgb, numbers, names), (true_rgb, true_numbers, true_names) = example(), drawn()
    np.testing.assert_array_equal(numbers, true_numbers)
    assert names == true_names
    assert np.abs(rgb.astype(int) - true_rgb).mean() < 3  # a JPEG file


def test_the_example_is_small():
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < 100_000
