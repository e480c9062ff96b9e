"""Diagrams show order, shapes and parameters of the blocks."""

import torch
from torch import nn

from zerobev.config import SCALES
from zerobev.models.variants import VARIANTS, build
from zerobev.report.diagram import Stage, draw_networks, stages

SMOKE = SCALES["smoke"]


class Backwards(nn.Module):
    """Blocks that are called in another order than they are made; one is a list, one is never called."""

    def __init__(self):
        super().__init__()
        self.last = nn.Linear(3, 2)
        self.split = nn.Unflatten(1, (2, 3))
        self.many = nn.ModuleList(nn.Linear(6, 6) for _ in range(2))
        self.idle = nn.Linear(1, 1)

    def forward(self, x):
        for layer in self.many:
            x = layer(x)
        return self.last(self.split(x))


def test_order_and_shapes_are_those_of_the_pass():
    assert stages(Backwards(), torch.zeros(4, 6)) == [
        Stage("many", ((6,), (6,)), 84),
        Stage("split", ((2, 3),), 0),
        Stage("last", ((2, 2),), 8),
    ]


def test_blocks_of_every_network_add_up():
    side, cells = SMOKE.camera.fpv_px, SMOKE.camera.bev_px
    images = (torch.rand(1, 3, side, side), torch.rand(1, 8, side, side), torch.ones(1, 1, side, side))
    for row in VARIANTS:
        network = build(row, SMOKE.camera, SMOKE.model).eval()
        found = stages(network, *images)
        assert sum(stage.parameters for stage in found) == sum(p.numel() for p in network.parameters()), row
        assert found[0].name == "backbone" and found[-1].name == "decoder"
        assert row == "b.1" or found[-1].shapes[0][1:] == (cells, cells)
    drawn = draw_networks([("one", found), ("two", found[:1])])
    texts = [text.get_text() for text in drawn.axes[0].texts if text.get_text()]
    assert [text.split("\n")[0] for text in texts] == [stage.name for stage in found]
