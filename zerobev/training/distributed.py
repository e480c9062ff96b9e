"""Training and evaluation in several processes (`accelerate launch`)."""

from torch import distributed


def rank_and_world_size() -> tuple[int, int]:
    """(rank, world size); (0, 1) if torch.distributed is not initialised."""
    if not distributed.is_initialized():
        return 0, 1
    return distributed.get_rank(), distributed.get_world_size()
