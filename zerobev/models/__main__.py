"""`python -m zerobev.models --scale paper`: the number of parameters, block by block, beside the paper's."""

import argparse
from pathlib import Path

from torch import nn

from zerobev.config import SCALES, scale
from zerobev.errors import run_command
from zerobev.models.zero_bev import ZeroBEV
from zerobev.paper import PARAMETERS_M
from zerobev.storage import write_json


def parameters(network: nn.Module) -> dict[str, int]:
    """Trainable parameters of each block of `network`, in the order of the pass, and their total."""
    table = {name: sum(p.numel() for p in block.parameters()) for name, block in network.named_children()}
    return {**table, "total": sum(table.values())}


def main() -> None:
    """Print the table; with `--json`, write it too."""
    parser = argparse.ArgumentParser(prog="python -m zerobev.models", description=__doc__)
    parser.add_argument("--scale", default="paper", help=f"one of {', '.join(SCALES)} (default: paper)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the table to FILE")
    arguments = parser.parse_args()
    chosen = scale(arguments.scale)
    table = parameters(ZeroBEV(chosen.camera, chosen.model))
    published = round(PARAMETERS_M["c"] * 1e6)
    for block, count in table.items():
        print(f"{block:<10}{count:>12,}")
    print(f"{'paper':<10}{published:>12,}  (Table 1, at scale paper)")
    if arguments.json:
        write_json(arguments.json, {"scale": chosen.name, "parameters": table, "paper_total": published})


if __name__ == "__main__":
    run_command(main)
