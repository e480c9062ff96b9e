"""A network drawn from the live model: its blocks in the order of a forward pass, with the shapes of their outputs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from torch import Tensor, nn

_FILL = {"backbone": "#cfe2f3", "zero_cnn": "#fce5cd", "decoder": "#d9ead3"}
_OTHER = "#eeeeee"
_STEP = 1.25  # between two boxes, in widths of a box


@dataclass(frozen=True)
class Stage:
    """A block of a network in a forward pass."""

    name: str
    shapes: tuple[tuple[int, ...], ...]  #: of its outputs, without the batch axis
    parameters: int


def stages(network: nn.Module, *inputs: Tensor) -> list[Stage]:
    """The blocks of `network` (its direct children) in the order of their outputs in a pass with `inputs`.

    A block with several outputs or calls, such as a list of layers, is one stage with all shapes.
    """
    shapes: dict[str, list[tuple[int, ...]]] = {}

    def noting(name: str) -> Callable[..., None]:
        def note(module: nn.Module, arguments: object, output: Tensor | Sequence[Tensor]) -> None:
            maps = [output] if isinstance(output, Tensor) else output
            shapes.setdefault(name, []).extend(tuple(one.shape[1:]) for one in maps if isinstance(one, Tensor))

        return note

    handles = []
    for name, block in network.named_children():
        called = block if isinstance(block, nn.ModuleList) else [block]
        handles += [module.register_forward_hook(noting(name)) for module in called]
    try:
        with torch.inference_mode():
            network(*inputs)
    finally:
        for handle in handles:
            handle.remove()
    children = dict(network.named_children())
    return [
        Stage(name, tuple(found), sum(p.numel() for p in children[name].parameters())) for name, found in shapes.items()
    ]


def draw_networks(networks: Sequence[tuple[str, Sequence[Stage]]]) -> Figure:
    """One line of boxes per network, with its title; a box shows name, parameters, and channels x rows x columns."""
    longest = max(len(blocks) for _, blocks in networks)
    size = (1.9 * longest, 1.75 * len(networks))
    figure, axes = plt.subplots(len(networks), figsize=size, squeeze=False, layout="constrained")
    for axis, (title, blocks) in zip(axes[:, 0], networks):
        axis.set_title(title, fontsize=11, loc="left")
        axis.set(xlim=(-0.05, _STEP * longest), ylim=(0, 1))
        axis.set_axis_off()
        for index, block in enumerate(blocks):
            _box(axis, _STEP * index, block)
            if index:
                arrow = {"arrowstyle": "->", "linewidth": 0.8}
                axis.annotate("", (_STEP * index, 0.5), (_STEP * (index - 1) + 1, 0.5), arrowprops=arrow)
    return figure


def _box(axis: Axes, x: float, block: Stage) -> None:
    outline = FancyBboxPatch(
        (x, 0.02), 1, 0.96, boxstyle="round,pad=0,rounding_size=0.06", facecolor=_FILL.get(block.name, _OTHER)
    )
    axis.add_patch(outline)
    lines = [" x ".join(map(str, shape)) for shape in block.shapes[:4]]
    text = "\n".join([block.name, f"{block.parameters / 1e6:.2f} M", *lines])
    axis.text(x + 0.5, 0.5, text, ha="center", va="center", fontsize=10)
