"""Predicted maps against true maps, for learned models and geometric baselines."""

from collections.abc import Callable, Iterable

import numpy as np
import torch
from torch import Tensor, distributed, nn

from zerobev.common.memory import keep_freed_memory
from zerobev.evaluation.metrics import Counts, count
from zerobev.training.distributed import rank_and_world_size
from zerobev.training.loader import Batch, model_inputs

#: From a batch to maps (B, K, M, M): floating-point logits, or binary maps (bool).
Predictor = Callable[[Batch], Tensor]


def evaluate(predict: Predictor, batches: Iterable[Batch], n_scenes: int, n_classes: int) -> Counts:
    """Intersections and unions of the maps of `predict`, per test scene (paper, supplement, "Metrics").

    predict: is called in inference mode; a cell is white if the sigmoid of its logit is above 0.5
    batches: the inputs of `predict`, and `target` (B, K, M, M), `fov` (B, 1, M, M), `scene` (B,) below n_scenes; each
        rank passes its own batches, and all ranks get the sum of all counts
    n_classes: K
    """
    keep_freed_memory()
    total = Counts.empty(n_scenes, n_classes)
    with torch.inference_mode():
        for batch in batches:
            maps = predict(batch).to(batch["target"].device)
            predicted = maps if maps.dtype == torch.bool else maps.float().sigmoid() > 0.5
            total += count(predicted, batch["target"], batch["fov"], batch["scene"], n_scenes)
    return _over_ranks(total)


def _over_ranks(counts: Counts) -> Counts:
    if rank_and_world_size()[1] == 1:
        return counts
    device = "cuda" if distributed.get_backend() == "nccl" else "cpu"
    sums = torch.from_numpy(np.stack((counts.intersection, counts.union))).to(device)
    distributed.all_reduce(sums)
    return Counts(*sums.cpu().numpy())


def model_predictor(model: nn.Module, device: torch.device | str) -> Predictor:
    """A learned model as a predictor: on `device`, in evaluation mode, in float32.

    The model is called as `model(rgb, zero, depth)`, without depth if the batch has none, and returns `zero_logits`.
    """
    model = model.to(device).eval()

    def predict(batch: Batch) -> Tensor:
        return model(*(image.to(device) for image in model_inputs(batch))).zero_logits

    return predict
