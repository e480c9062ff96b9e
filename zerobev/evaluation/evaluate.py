"""Predicted maps against true maps, for learned models and geometric baselines."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, distributed, nn

from zerobev.common.memory import keep_freed_memory
from zerobev.data.visibility import VISIBILITY, Visibility
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
    total = Counts.empty(n_scenes, n_classes)
    for batch, predicted in _predictions(predict, batches):
        total += count(predicted, batch["target"], batch["fov"], batch["scene"], n_scenes)
    return _over_ranks(total)


@dataclass(frozen=True)
class PartCounts:
    """Counts in one part of the maps' cells."""

    iou: Counts
    recall: Counts  #: intersections, and the cells of the true masks in place of unions


def evaluate_parts(
    predict: Predictor, batches: Iterable[Batch], n_scenes: int, n_classes: int
) -> dict[Visibility, PartCounts]:
    """As `evaluate`, separately for the parts of `data.visibility`, which together are the field of view.

    batches: as for `evaluate`, with `visibility` (B, 3, M, M)
    """
    empty = Counts.empty(n_scenes, n_classes)
    total = {part: PartCounts(empty, empty) for part in VISIBILITY}
    for batch, predicted in _predictions(predict, batches):
        for number, part in enumerate(VISIBILITY):
            cells = (batch["fov"] > 0.5) & (batch["visibility"][:, [number]] > 0.5)
            target = batch["target"] > 0.5
            iou, recall = (
                count(found, target, cells, batch["scene"], n_scenes) for found in (predicted, predicted & target)
            )
            total[part] = PartCounts(total[part].iou + iou, total[part].recall + recall)
    return {part: PartCounts(_over_ranks(one.iou), _over_ranks(one.recall)) for part, one in total.items()}


def _predictions(predict: Predictor, batches: Iterable[Batch]) -> Iterator[tuple[Batch, Tensor]]:
    """Batches with their maps (B, K, M, M) bool."""
    keep_freed_memory()
    with torch.inference_mode():
        for batch in batches:
            maps = predict(batch).to(batch["target"].device)
            yield batch, maps if maps.dtype == torch.bool else maps.float().sigmoid() > 0.5


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
