"""The picture that opens the README and the tour: image, mask, projection, map by the network, and truth."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from zerobev.config import LABELS, TextureConfig
from zerobev.data.views import View, ViewSource
from zerobev.inference import Projector
from zerobev.report.figures import COLORS, NOTHING, add_scale, grid, mask_image
from zerobev.scenes.scene import Scene

_DRAWS, _FPV_PX = 40, 256


def opening_figure(
    scene: Scene, projection: Projector, network: Projector, classes: Sequence[str], seed: int
) -> Figure:
    """One line per class: photograph, mask, map by `projection`, map by `network`, true map.

    seed: of 40 random views; the one is shown in which the smallest of the classes has the largest true area
    """
    index = [LABELS.index(name) for name in classes]
    camera = replace(network.camera, fpv_px=_FPV_PX)
    source = ViewSource(scene, camera, TextureConfig(), np.random.default_rng(seed))

    def visible(view: View) -> float:
        seen, true = scene.instance_label[view.fpv_instance], scene.instance_label[view.bev_instance]
        return min(min(float((seen == k).sum()) / 16, float(((true == k) & view.fov).sum())) for k in index)

    view = max((source.draw() for _ in range(_DRAWS)), key=visible)
    seen, true = scene.instance_label[view.fpv_instance], scene.instance_label[view.bev_instance]
    masks = np.stack([seen == k for k in index])
    found = [one.project(view.rgb, masks).maps for one in (projection, network)]
    colors = [COLORS[k] for k in index]
    shown = [
        [mask_image(one & view.fov, view.fov, color, NOTHING) for one, color in zip(maps, colors)] for maps in found
    ]
    whole = np.ones_like(masks[0])
    figure = grid(
        [
            ("an image", [view.rgb] * len(index)),
            ("a mask in it", [mask_image(mask, whole, color, NOTHING) for mask, color in zip(masks, colors)]),
            ("projected with\nestimated depth", shown[0]),
            ("Zero-BEV", shown[1]),
            ("the truth", [mask_image((true == k) & view.fov, view.fov, COLORS[k], NOTHING) for k in index]),
        ],
        side=1.8,
    )
    for axes, name in zip(figure.axes[1::5], classes):
        axes.text(0.03, 0.97, name, transform=axes.transAxes, va="top", fontsize=9)
    for axes in figure.axes[4::5]:
        add_scale(axes, network.camera.bev_px)
    return figure
