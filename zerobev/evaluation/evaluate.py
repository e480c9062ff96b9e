"""Predicted maps against true ones, for learned models and geometric baselines alike.

As a command, `zerobev.evaluation.real_homes`: the shipped weights on a folder of homes.
"""

from collections.abc import Callable, Iterable, Mapping

import numpy as np
import torch
from torch import Tensor, distributed, nn

from zerobev.evaluation.metrics import Counts, count

Batch = Mapping[str, Tensor]
#: From a batch to maps (B, K, M, M): floating-point logits, or booleans that are taken as they are.
Predictor = Callable[[Batch], Tensor]


def evaluate(
    predict: Predictor, batches: Iterable[Batch], n_scenes: int, n_classes: int, threshold: float = 0.5
) -> Counts:
    """Intersections and unions of the maps of `predict`, per test scene (paper, supplement, "Metrics").

    predict: is called in inference mode; logits are passed through a sigmoid and thresholded (strictly above)
    batches: each with what `predict` needs, and `target` (B, K, M, M), `fov` (B, 1, M, M), `scene` (B,) below n_scenes;
        of several processes each brings its own, and gets the counts of all
    n_classes: K
    """
    total = Counts.empty(n_scenes, n_classes)
    with torch.inference_mode():
        for batch in batches:
            maps = predict(batch).to(batch["target"].device)
            predicted = maps if maps.dtype == torch.bool else maps.float().sigmoid() > threshold
            total += count(predicted, batch["target"], batch["fov"], batch["scene"], n_scenes)
    return _over_processes(total)


def place() -> tuple[int, int]:
    """Rank of this process, and the number of those that train and evaluate together: (0, 1) where it is alone."""
    if not distributed.is_initialized():
        return 0, 1
    return distributed.get_rank(), distributed.get_world_size()


def _over_processes(counts: Counts) -> Counts:
    if place()[1] == 1:
        return counts
    device = "cuda" if distributed.get_backend() == "nccl" else "cpu"
    sums = torch.from_numpy(np.stack((counts.intersection, counts.union))).to(device)
    distributed.all_reduce(sums)
    return Counts(*sums.cpu().numpy())


def model_predictor(model: nn.Module, device: torch.device | str) -> Predictor:
    """A learned model as a predictor: moved to `device`, in evaluation mode, in float32.

    The model is called as `model(rgb, zero, depth)`, depth where the batch has it, and returns logits as `zero_logits`.
    """
    model = model.to(device).eval()

    def predict(batch: Batch) -> Tensor:
        return model(*(image.to(device) for image in model_inputs(batch))).zero_logits

    return predict


def model_inputs(batch: Batch) -> list[Tensor]:
    """What a model is called with: `rgb`, `zero`, and `depth` where the batch has it."""
    return [batch[name] for name in ("rgb", "zero", "depth") if name in batch]


if __name__ == "__main__":
    from zerobev.common.errors import run_command
    from zerobev.evaluation.real_homes import main

    run_command(main)
