"""Predicted maps against true ones, for learned models and geometric baselines alike."""

from collections.abc import Callable, Iterable

import numpy as np
import torch
from torch import Tensor, distributed, nn

from zerobev.common.memory import keep_freed_memory
from zerobev.evaluation.metrics import Counts, count
from zerobev.training.distributed import rank_and_world_size
from zerobev.training.loader import Batch, model_inputs

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
    keep_freed_memory()
    total = Counts.empty(n_scenes, n_classes)
    with torch.inference_mode():
        for batch in batches:
            maps = predict(batch).to(batch["target"].device)
            predicted = maps if maps.dtype == torch.bool else maps.float().sigmoid() > threshold
            total += count(predicted, batch["target"], batch["fov"], batch["scene"], n_scenes)
    return _over_processes(total)


def _over_processes(counts: Counts) -> Counts:
    if rank_and_world_size()[1] == 1:
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
