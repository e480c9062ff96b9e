"""The gallery: test views for which each run stores its predicted maps, so that figures need no checkpoint."""

import numpy as np

from zerobev.common.keys import fingerprint
from zerobev.data.view_set import ViewSet
from zerobev.experiments.run_records import RunStore
from zerobev.experiments.workspace import Workspace

GALLERY_VIEWS = 8


def gallery(workspace: Workspace) -> dict[str, np.ndarray]:
    """Inputs and true maps of the gallery's views.

    rgb (N, H, H, 3) uint8; fpv_label (N, H, H) and bev_label (N, M, M) int8; fov (N, M, M) bool.
    """
    store = RunStore(workspace.reports)
    name = f"views-{fingerprint(workspace.data_config)}"
    if (found := store.gallery(name)) is not None:
        return found
    views = workspace.views("test")
    located = [views.locate(i) for i in gallery_indices(views)]
    labels = [views.shards[shard].instance_label for shard, _ in located]
    made = {
        "rgb": np.stack([view.rgb for _, view in located]),
        "fpv_label": np.stack([label[view.fpv_instance] for label, (_, view) in zip(labels, located)]),
        "bev_label": np.stack([label[view.bev_instance] for label, (_, view) in zip(labels, located)]),
        "fov": np.stack([view.fov for _, view in located]),
    }
    store.write_gallery(name, **made)
    return made


def gallery_indices(views: ViewSet) -> list[int]:
    """Indices of the gallery's views, spread evenly over the test views."""
    return np.linspace(0, len(views) - 1, min(GALLERY_VIEWS, len(views))).round().astype(int).tolist()
