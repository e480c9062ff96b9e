"""Pictures of a running training."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor, nn

from zerobev.common.storage import replacing
from zerobev.training.loader import model_inputs

_SAMPLES = 4  # shown, of a batch


def write_picture(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=90, bbox_inches="tight")


def curves_figure(curves: Mapping[str, Sequence[float | None]]) -> Figure:
    """Training losses and validation scores over steps; `curves` as from `training.history.columns`."""
    figure = Figure(figsize=(6, 3))
    axes = figure.subplots()
    for name, style in {"main": "-", "aux": "-", "validation": "o-"}.items():
        points = [(step, value) for step, value in zip(curves["step"], curves[name]) if value is not None]
        if points:
            axes.plot(*zip(*points), style, label=name)
    axes.set(xlabel="step", ylabel="loss", ylim=(0, None))
    axes.legend()
    return figure


def maps_figure(model: nn.Module, batch: Mapping[str, Tensor]) -> Figure:
    """Samples of a batch, one per row: RGB image, and zero-shot image, predicted map and true map of one modality.

    Drawn without pyplot, which would show the figure in a notebook.

    model: returns a `MapLogits`; in evaluation mode
    batch: of `data.samples`, on the model's device
    """
    some = {name: value[:_SAMPLES] for name, value in batch.items()}
    with torch.no_grad():
        predicted = model(*model_inputs(some)).zero_logits.float().sigmoid()[:, 0] * some["fov"][:, 0]
    columns = {
        "photograph": some["rgb"].permute(0, 2, 3, 1),
        "zero-shot image": some["zero"][:, 0],
        "predicted map": predicted,
        "true map": some["target"][:, 0] * some["fov"][:, 0],
    }
    figure = Figure(figsize=(1.6 * len(columns), 1.6 * len(some["rgb"])))
    panels = figure.subplots(len(some["rgb"]), len(columns), squeeze=False)
    for column, (title, images) in zip(panels.T, columns.items()):
        column[0].set_title(title, fontsize=8)
        for axes, image in zip(column, images.cpu().numpy()):
            axes.imshow(image, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
            axes.set_axis_off()
    return figure
