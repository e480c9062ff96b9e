"""Zero-BEV: zero-shot projection of any first-person modality to a bird's-eye-view map.

`zerobev.load().project(rgb, modality)` is all that most uses need; see `zerobev.inference`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from zerobev.inference import BevArrows, BevMap, Boxes, Flow, Labels, Masks, Probabilities, Projector, load

__version__ = "0.2.0.dev0"

__all__ = ["BevArrows", "BevMap", "Boxes", "Flow", "Labels", "Masks", "Probabilities", "Projector", "load"]


def __getattr__(name: str) -> Any:
    # imported when first asked for: most commands of the package need no network
    if name in __all__:
        import zerobev.inference

        return getattr(zerobev.inference, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
