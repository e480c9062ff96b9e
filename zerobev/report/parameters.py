"""Count the parameters of each network, per block, and compare with the paper.

Reads nothing; prints a table and writes the totals with `--json`.
"""

import argparse
from pathlib import Path

import torch
from torch import nn

from zerobev.common.storage import write_json
from zerobev.config import SCALES, scale
from zerobev.models.variants import VARIANTS, build
from zerobev.report.paper import PARAMETERS_M

BLOCKS = (
    *("backbone", "zero_cnn", "pyramid", "bands", "view", "outs", "gates", "values", "embedding", "decoder"),
    "total",
)


def parameters(network: nn.Module) -> dict[str, int]:
    """Number of parameters per block of `network` (its direct children), and their total."""
    table = {name: sum(p.numel() for p in block.parameters()) for name, block in network.named_children()}
    return {**table, "total": sum(table.values())}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `zerobev parameters`."""
    parser.add_argument("--scale", default="paper", help=f"one of {', '.join(SCALES)} (default: paper)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write {row: parameters} to FILE")


def run(options: argparse.Namespace) -> None:
    """Print the table; with `--json`, also write the total of each row."""
    chosen = scale(options.scale)
    with torch.device("meta"):  # shapes without memory
        tables = {row: parameters(build(row, chosen.camera, chosen.model)) for row in VARIANTS}
    print(f"{'row':<5}{'network':<17}" + "".join(f"{block:>12}" for block in BLOCKS) + f"{'paper':>9}")
    for row, table in tables.items():
        counts = "".join(f"{table[block]:>12,}" if block in table else f"{'':>12}" for block in BLOCKS)
        published = f"{PARAMETERS_M[row]:>7g} M" if row in PARAMETERS_M else ""
        print(f"{row:<5}{VARIANTS[row][0].__name__:<17}{counts}{published}")
    print("paper: Table 1, at scale paper; of (d) without the depth estimator")
    if options.json:
        write_json(options.json, {row: table["total"] for row, table in tables.items()})
