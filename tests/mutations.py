"""Mutation tests: `python -m tests.mutations [NAME ...]` makes one wrong change at a time and runs its tests.

All happens in a temporary copy of the working tree. The tests first run without any change and must pass. Exit code 1
if a change is missed.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from zerobev.common.errors import InputError, run_command

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Mutation:
    """A wrong change, and the tests of `make test` of which one must fail."""

    name: str
    file: str  #: path or pattern; all matching files are changed
    old: str | re.Pattern[str]  #: must occur once per file
    new: str | Callable[[re.Match[str]], str]
    tests: tuple[str, ...]  #: arguments of pytest

    def apply(self, text: str) -> str:
        """The text with the change. Raises `InputError` unless `old` occurs exactly once."""
        pattern = self.old if isinstance(self.old, re.Pattern) else re.compile(re.escape(self.old))
        found = len(pattern.findall(text))
        if found != 1:
            raise InputError(f"{self.name}: expected {pattern.pattern!r} once in {self.file}, found it {found} times")
        if isinstance(self.old, str):
            return text.replace(self.old, str(self.new))
        return pattern.sub(self.new, text)


def _one_less(match: re.Match[str]) -> str:
    return match[0][:-1] + str((int(match[0][-1]) - 1) % 10)


_RECORDS = ("tests/integrity/test_trust.py::test_records_are_as_they_were_written",)
_RUNS = "tests/unit/experiments/test_runs.py::"

MUTATIONS = (
    # numbers
    Mutation(
        "one cell less in a record",
        "reports/reduced/records/c-seed0-*.json",
        re.compile(r'"intersection": \[\[\d+'),
        _one_less,
        _RECORDS,
    ),
    Mutation(
        "one cell less in a smoke record",
        "reports/smoke/records/b.2-seed0-*.json",
        re.compile(r'"intersection": \[\[\d+'),
        _one_less,
        _RECORDS,
    ),
    Mutation(
        "two published rows of Table 1 swapped",
        "zerobev/report/paper.py",
        re.compile(r'(\("b\.1", "VPN[^"]*", )("[^"]*")(\),\s*\("b\.2", "TIM[^"]*", )("[^"]*")'),
        r"\1\4\3\2",
        ("tests/unit/report/test_claims.py::test_every_claim_names_rows_of_its_table_and_holds_in_the_paper",),
    ),
    Mutation(
        "two published rows of Table 4 swapped",
        "zerobev/report/paper.py",
        re.compile(r'(\("c\.10", "[^"]*", )("[^"]*")(\),\s*\("c\.15", "[^"]*", )("[^"]*")'),
        r"\1\4\3\2",
        ("tests/integrity/test_trust.py::test_published_numbers_are_unchanged",),
    ),
    # axes of the map
    Mutation(
        "cells far and near exchanged",
        "zerobev/geometry/cameras.py",
        "across[::-1])",
        "across)",
        ("tests/unit/geometry/test_cameras.py",),
    ),
    Mutation(
        "cells left and right exchanged",
        "zerobev/geometry/cameras.py",
        "np.meshgrid(across - camera.bev_extent_m / 2,",
        "np.meshgrid(camera.bev_extent_m / 2 - across,",
        ("tests/unit/geometry/test_cameras.py",),
    ),
    Mutation(
        "projection far and near exchanged",
        "zerobev/geometry/projection.py",
        "row = side - 1 - torch.floor(y / camera.cell_m).long()",
        "row = torch.floor(y / camera.cell_m).long()",
        ("tests/unit/geometry/test_projection.py",),
    ),
    Mutation(
        "projection left and right exchanged",
        "zerobev/geometry/projection.py",
        "torch.floor((x + camera.bev_extent_m / 2)",
        "torch.floor((camera.bev_extent_m / 2 - x)",
        ("tests/unit/geometry/test_projection.py",),
    ),
    Mutation(
        "a limit on heights that falls with the camera's height",
        "zerobev/geometry/projection.py",
        "camera.max_height_m * camera.height_m / height_m",
        "camera.max_height_m * height_m / camera.height_m",
        ("tests/unit/inference/test_projector.py::test_a_limit_on_heights_follows_the_camera_s_height",),
    ),
    # cameras
    Mutation(
        "roll to the other side",
        "zerobev/geometry/cameras.py",
        "[[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]]",
        "[[cr, sr, 0], [-sr, cr, 0], [0, 0, 1]]",
        ("tests/unit/inference/test_pinhole.py",),
    ),
    Mutation(
        "no stretch for another height of a level camera",
        "zerobev/inference/pinhole.py",
        "fy *= camera.height_m / network.height_m",
        "fy *= 1",
        ("tests/unit/inference/test_pinhole.py",),
    ),
    Mutation(
        "photographs from another height without the stretch",
        "zerobev/rendering/photograph.py",
        "self._eye.camera.fx / pose.stretch(self._camera)",
        "self._eye.camera.fx",
        ("tests/unit/data/test_augment.py",),
    ),
    Mutation(
        "mirrored images with maps as they were",
        "zerobev/data/augment.py",
        '"depth", "target", "aux", "fov")',
        '"depth")',
        ("tests/unit/data/test_augment.py",),
    ),
    Mutation(
        "the pyramid of a zero-shot image with weights of the RGB image",
        "zerobev/models/pyramid.py",
        "weight[:, -m.shape[1] :]",
        "weight[:, : m.shape[1]]",
        ("tests/unit/models/test_networks.py",),
    ),
    # an image once
    Mutation(
        "every photograph of a batch with the features of the first",
        "zerobev/inference/image_view.py",
        "tensor[n : n + 1] for tensor in features",
        "tensor[:1] for tensor in features",
        ("tests/unit/inference/test_image_view.py::test_a_batch_gives_the_maps_of_single_calls_in_one_pass",),
    ),
    Mutation(
        "evidence without the empty image",
        "zerobev/inference/image_view.py",
        "(logits - empty).clamp(min=0)",
        "logits.clamp(min=0)",
        ("tests/unit/inference/test_projector.py::test_a_projector_gives_the_output_of_its_network",),
    ),
    Mutation(
        "weights in the precision of the copy",
        "zerobev/inference/placement.py",
        "copy.deepcopy(module).to(device, dtype)",
        "module.to(device, dtype)",
        ("tests/unit/inference/test_image_view.py::test_precision_is_a_copy_s_and_changes_maps_by_rounding_alone",),
    ),
    # the map of a home
    Mutation(
        "maps turned to the other side",
        "zerobev/mapping/grid.py",
        "(dx * s - dy * c + half)",
        "(dy * c - dx * s + half)",
        ("tests/unit/mapping/test_home_map.py",),
    ),
    Mutation(
        "evidence also outside the field of view",
        "zerobev/mapping/home_map.py",
        "visible = inside & bev.fov[row, column]",
        "visible = inside",
        ("tests/unit/mapping/test_home_map.py",),
    ),
    Mutation(
        "unknown cells free for a robot",
        "zerobev/mapping/nav2.py",
        "_OCCUPIED_FROM, _FREE_BELOW = 0.65, 0.196",
        "_OCCUPIED_FROM, _FREE_BELOW = 0.65, 0.25",
        ("tests/unit/mapping/test_nav2.py",),
    ),
    Mutation(
        "a map for robots upside down",
        "zerobev/mapping/nav2.py",
        "image.astype(np.uint8)",
        "image[::-1].astype(np.uint8)",
        ("tests/unit/mapping/test_nav2.py",),
    ),
    Mutation(
        "a true map of a home one cell to the side",
        "zerobev/evaluation/walks.py",
        "Pose(grid.x0 + side / 2,",
        "Pose(grid.x0 + side / 2 + grid.cell_m,",
        ("tests/unit/evaluation/test_walks.py::test_the_true_map_is_that_of_a_view_on_the_same_grid",),
    ),
    # the zero-shot stream
    Mutation(
        "zero-shot image one pixel to the right",
        "zerobev/data/samples.py",
        '"zero": zero,',
        '"zero": np.roll(zero, 1, axis=-1),',
        ("tests/unit/data/test_samples.py",),
    ),
    Mutation(
        "textures one pixel down",
        "zerobev/data/samples.py",
        "[image.reshape(-1, 3) for image in texels]",
        "[np.roll(image, i == 0, 0).reshape(-1, 3) for i, image in enumerate(texels)]",
        ("tests/unit/data/test_samples.py",),
    ),
    Mutation(
        "extruded textures without the heading of the camera",
        "zerobev/data/samples.py",
        "(x * right + y * forward + view.pose[axis])",
        "(x * (axis == 0) + y * (axis == 1) + view.pose[axis])",
        ("tests/unit/data/test_samples.py",),
    ),
    Mutation(
        "a whole batch for each rank",
        "zerobev/training/loader.py",
        "self._source.batch(step, self._rank, self._world_size)",
        "self._source.batch(step)",
        ("tests/unit/training/test_loader.py",),
    ),
    # splits
    Mutation(
        "trained on the test homes",
        "zerobev/experiments/runs.py",
        'self.source("train", depth, self.seed)',
        'self.source("test", depth, self.seed)',
        (f"{_RUNS}test_training_never_opens_a_test_scene",),
    ),
    Mutation(
        "validated on the test homes",
        "zerobev/experiments/runs.py",
        'self.source("validation",',
        'self.source("test",',
        (f"{_RUNS}test_training_never_opens_a_test_scene",),
    ),
    # depth of (a.2)
    Mutation(
        "true depth for (a.2), as configured",
        "zerobev/experiments/registry.py",
        'Experiment("a.2", None)',
        'Experiment("a.2", None, test_depth="true")',
        (f"{_RUNS}test_every_row_of_every_table_is_a_run_and_each_run_is_one_row",),
    ),
    Mutation(
        "true depth for (a.2), as computed",
        "zerobev/experiments/runs.py",
        'test = self.views("test", "estimated" if estimated else "true")',
        'test = self.views("test", "true")',
        (f"{_RUNS}test_projections_use_the_depth_of_their_row",),
    ),
    # the theorem
    Mutation(
        "learned values instead of the identity",
        "zerobev/theory/attention.py",
        "return self.attention(features) @ values\n",
        "return self.aux(features, values)\n",
        ("tests/unit/theory/test_theory.py::test_cross_attention_is_the_scaled_dot_product",),
    ),
    # speed and memory
    Mutation(
        "views cached in memory",
        "zerobev/data/shards.py",
        "h5py.File(self.path, rdcc_nbytes=0)",
        "h5py.File(self.path)",
        ("tests/unit/data/test_shards.py::test_views_are_not_cached",),
    ),
    Mutation(
        "a benchmark of earlier code",
        "zerobev/experiments/versions.py",
        re.compile(r"BENCHMARK = \d+"),
        lambda match: f"{match[0]}0",
        ("tests/integrity/test_trust.py::test_measurements_were_made_by_this_code",),
    ),
)


def copy_tree(to: Path) -> None:
    """Copy all files of the working tree that git does not ignore."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=True,
        text=True,
    )
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, to / name)


def run_tests(tree: Path, tests: tuple[str, ...]) -> subprocess.CompletedProcess[str]:
    """Run pytest on the package in `tree`, until the first failure."""
    # no bytecode: a stale file could hide a change
    variables = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    return subprocess.run(command, cwd=tree, env=variables, capture_output=True, text=True, check=False)


@contextmanager
def mutated(tree: Path, mutation: Mutation) -> Iterator[None]:
    """Apply the change, and undo it at the end of the `with`."""
    before = {path: path.read_text() for path in sorted(tree.glob(mutation.file))}
    if not before:
        raise InputError(f"{mutation.name}: expected a file {mutation.file}, found none")
    changed = {path: mutation.apply(text) for path, text in before.items()}
    for path, text in changed.items():
        path.write_text(text)
    try:
        yield
    finally:
        for path, text in before.items():
            path.write_text(text)


def outcome(tree: Path, mutation: Mutation) -> str:
    """Result of a change: "caught by TEST", "missed", or the reason why it is unknown."""
    with mutated(tree, mutation):
        ran = run_tests(tree, mutation.tests)
    if ran.returncode not in (0, 1):  # 1: a test failed; others are errors of pytest
        return f"unknown: pytest ended with {ran.returncode}"
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", ran.stdout, re.MULTILINE)
    return f"caught by {failed[1]}" if ran.returncode and failed else "missed"


def main() -> None:
    """Parse the command line, try the changes, print the results."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutations", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="; ".join(mutation.name for mutation in MUTATIONS))
    names = parser.parse_args().names or [mutation.name for mutation in MUTATIONS]
    if unknown := set(names) - {mutation.name for mutation in MUTATIONS}:
        raise InputError(f"names: expected some of those of --help, found {', '.join(sorted(unknown))}")
    chosen = [mutation for mutation in MUTATIONS if mutation.name in names]
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "zerobev"
        copy_tree(tree)
        unchanged = run_tests(tree, tuple(dict.fromkeys(test for mutation in chosen for test in mutation.tests)))
        if unchanged.returncode:
            raise InputError(f"tests: expected none to fail without a change, found:\n{unchanged.stdout[-2000:]}")
        missed = 0
        for mutation in chosen:
            start = time.monotonic()
            found = outcome(tree, mutation)
            missed += not found.startswith("caught")
            print(f"{mutation.name:40} {time.monotonic() - start:6.1f} s  {found}", flush=True)
    print(f"{len(chosen) - missed} of {len(chosen)} caught")
    if missed:
        sys.exit(1)


if __name__ == "__main__":
    run_command(main)
