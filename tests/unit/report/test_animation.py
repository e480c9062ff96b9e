"""The animation of a walk: one frame per map, with the map's colours at their place."""

import io

import numpy as np
from PIL import Image

from zerobev.config import LABELS
from zerobev.mapping import Pose2D
from zerobev.mapping.grid import Grid
from zerobev.report.animation import walk_animation
from zerobev.report.figures import COLORS


def test_a_frame_per_map_shows_the_map_at_that_time():
    maps = np.zeros((8, 4, 6), bool)
    maps[LABELS.index("sofa"), :, :3] = True
    seen = [np.zeros((4, 6), bool), np.ones((4, 6), bool)]
    photographs = np.stack([np.full((16, 16, 3), value, np.uint8) for value in (30, 200)])
    grid = Grid.of((0, 0, 6, 4), 1.0)
    poses = [Pose2D(1, 1, 0), Pose2D(2, 1, 0)]
    frames = [(1, maps, seen[0]), (2, maps, seen[1])]
    shown = walk_animation(photographs, frames, np.zeros_like(maps), poses, grid)
    assert shown.data == walk_animation(photographs, frames, np.zeros_like(maps), poses, grid).data
    with Image.open(io.BytesIO(shown.data)) as file:
        assert file.n_frames == 2 and file.info["loop"] == 0
        pictures = []
        for number in range(2):
            file.seek(number)
            pictures.append(np.asarray(file.convert("RGB")).astype(int))
    sofa = np.array([int(COLORS[LABELS.index("sofa")][k : k + 2], 16) for k in (1, 3, 5)])
    near = [np.abs(picture - sofa).max(axis=-1) < 12 for picture in pictures]
    assert not near[0].any() and near[1].sum() > 1000
    width = near[1].shape[1]
    assert width / 3 < np.argwhere(near[1])[:, 1].min() < np.argwhere(near[1])[:, 1].max() < 2 * width / 3
    for picture, value in zip(pictures, (30, 200)):
        assert (np.abs(picture[picture.shape[0] // 2, width // 6] - value) < 12).all()
