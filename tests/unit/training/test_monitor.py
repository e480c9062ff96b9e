"""The pictures of a training, read back as pixels."""

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor, nn

from zerobev.models.base import MapLogits
from zerobev.training.monitor import curves_figure, maps_figure, write_picture


class Echo(nn.Module):
    """Predicts the zero-shot image."""

    def forward(self, rgb: Tensor, zero: Tensor) -> MapLogits:
        return MapLogits(20 * zero - 10, None)


def test_curves_leave_out_missing_values():
    steps = [10, 20, 30]
    curves = {"step": steps, "main": [0.9, 0.7, 0.6], "aux": [None] * 3, "validation": [None, 0.8, None]}
    (axes,) = curves_figure(curves).axes
    drawn = {line.get_label(): (list(line.get_xdata()), list(line.get_ydata())) for line in axes.lines}
    assert drawn == {"main": (steps, [0.9, 0.7, 0.6]), "validation": ([20], [0.8])}


def test_maps_match_the_batch_and_are_black_outside_the_field_of_view(tmp_path):
    zero = torch.zeros(6, 1, 4, 4)
    zero[:, :, 1] = 1
    fov = torch.ones(6, 1, 4, 4)
    fov[..., 0] = 0
    batch = {"rgb": torch.rand(6, 3, 4, 4), "zero": zero, "target": zero, "fov": fov}
    figure = maps_figure(Echo(), batch)
    shown = [axes.images[0].get_array() for axes in figure.axes]
    assert len(shown) == 4 * 4  # four samples of four images
    photograph, image, predicted, true = shown[:4]
    assert np.array_equal(photograph, batch["rgb"][0].permute(1, 2, 0)) and np.array_equal(image, zero[0, 0])
    assert np.asarray(predicted) == pytest.approx(np.asarray(true), abs=1e-3)
    assert not true[:, 0].any() and true[1, 1:].all()
    write_picture(figure, tmp_path / "sample.png")
    assert [path.name for path in tmp_path.iterdir()] == ["sample.png"]
    assert np.asarray(Image.open(tmp_path / "sample.png")).std() > 0
