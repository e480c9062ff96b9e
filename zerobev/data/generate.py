"""Record scenes as shards of views.

Reads scenes in HM3DSem layout; writes `train/`, `validation/` and `test/` with a shard per scene and a manifest into
`--out`. Scenes are distributed over processes (`--workers`) or the workers of a dask cluster (`--dask`). A shard
depends only on the scene, the configuration, the number of views and the seed, so its bytes do not depend on the number
of workers. Shards are written atomically: after an interruption, the same command continues. `--verify` checks the
shards against the manifest.
"""

import argparse
import gc
import json
import sys
import zlib
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from zerobev.common.errors import InputError, attempt
from zerobev.common.keys import matches, plain
from zerobev.common.memory import return_freed_memory
from zerobev.common.parallel import cluster, run_jobs
from zerobev.common.progress import progress
from zerobev.common.storage import write_json
from zerobev.config import SCALES, SPLITS, CameraConfig, TextureConfig, scale
from zerobev.data.shards import Shard, checksum, recorded_with, write_shard
from zerobev.data.views import ViewSource
from zerobev.scenes.readers import read_scene, split_scenes

_MANIFEST = "manifest.json"

#: Range of the cameras' heights, see `ViewSource`.
Heights = tuple[float, float] | None


def shard_path(scene_folder: Path, out: Path) -> Path:
    """The path of a scene's shard."""
    return out / f"{scene_folder.name}.h5"


def generate_shard(
    scene_folder: Path,
    out: Path,
    views: int,
    camera: CameraConfig,
    texture: TextureConfig,
    seed: int,
    heights_m: Heights = None,
) -> Path:
    """Record `views` views of one scene unless its shard exists; returns the shard's path.

    Raises `InputError` for a broken scene, and for a shard that is damaged or of another run.
    """
    path = shard_path(scene_folder, out)
    if path.exists():
        _check_run(path, views, camera, texture, seed)
        return path
    if views < 1:
        raise InputError(f"views: expected 1 or more, found {views}")
    for unfinished in out.glob(f".{path.stem}.*.part.h5"):  # left by a killed process
        unfinished.unlink(missing_ok=True)
    scene = read_scene(scene_folder)
    rng = np.random.default_rng(_scene_seed(scene_folder, seed))
    source = ViewSource(scene, camera, texture, rng, heights_m)
    write_shard(path, scene, (source.draw() for _ in range(views)), camera, texture, seed)
    return path


def generate(
    scene_folders: list[Path],
    out: Path,
    views: int,
    camera: CameraConfig,
    texture: TextureConfig,
    seed: int,
    workers: int = 1,
    heights_m: Heights = None,
) -> dict[str, str]:
    """Record every scene into `out` and write `manifest.json` there: configuration, seeds, SHA-256 of each shard.

    `workers` is the number of processes, unless `joblib.parallel_config` selects another back end. A scene that fails
    is skipped; an existing shard of another run, or with another checksum than the manifest's, is a failure and stays.
    Returns the failures, scene name -> message. Raises `InputError` if `out` has a manifest of another run.
    """
    run = {**recorded_with(camera, texture), "seed": seed, "views": views}
    if heights_m is not None:
        run["heights_m"] = heights_m
    listed = _listed(out, run)
    existing = [folder for folder in scene_folders if shard_path(folder, out).exists()]
    missing = [folder for folder in scene_folders if folder not in existing]
    found: dict[Path, str | InputError] = {}
    for folders, sums, what in (existing, listed, "existing shards"), (missing, {}, f"views of {out.name}"):
        jobs = (
            joblib.delayed(_attempt)(
                folder,
                out,
                views,
                camera,
                texture,
                seed,
                heights_m,
                sums.get(shard_path(folder, out).name, {}).get("sha256"),
            )
            for folder in folders
        )
        found |= zip(
            folders, list(run_jobs(jobs, workers, what, len(folders)))
        )  # `list` runs the generator to its end, as joblib requires
    recorded = {
        shard_path(folder, out).name: {"seed": _scene_seed(folder, seed), "sha256": outcome}
        for folder, outcome in found.items()
        if isinstance(outcome, str)
    }
    write_json(out / _MANIFEST, {**plain(run), "shards": listed | recorded})
    return {folder.name: str(outcome) for folder, outcome in found.items() if isinstance(outcome, InputError)}


def _attempt(
    folder: Path,
    out: Path,
    views: int,
    camera: CameraConfig,
    texture: TextureConfig,
    seed: int,
    heights_m: Heights,
    listed: str | None,
) -> str | InputError:
    """SHA-256 of the scene's shard, recorded now if missing, or its failure; it has to be `listed`, if given."""

    def record() -> str:
        path = generate_shard(folder, out, views, camera, texture, seed, heights_m)
        if listed:
            _check_sum(path, listed)
        return checksum(path)

    try:
        return attempt(record)
    finally:
        # meshes have reference cycles, and freed memory is kept in small pieces; joblib would suspect a memory leak and
        # replace the worker, which costs as much as a scene
        gc.collect()
        return_freed_memory()


def _scene_seed(scene_folder: Path, seed: int) -> list[int]:
    """Seed of a scene's views. It depends on the scene's name, not on the other scenes."""
    return [seed, zlib.crc32(scene_folder.name.encode())]


def _listed(out: Path, run: dict[str, Any]) -> dict[str, Any]:
    """The manifest's entries per shard, empty without a manifest; a manifest of another run is an `InputError`."""
    path = out / _MANIFEST
    if not path.exists():
        return {}
    manifest = _read_manifest(out)
    shards = manifest.pop("shards")
    if not matches(manifest, run):
        raise InputError(f"{path}: expected a manifest of {plain(run)}, found one of {manifest}")
    return shards


def verify(out: Path) -> list[str]:
    """Check the shards in `out` against its manifest; returns a message per missing, damaged or foreign shard.

    Raises `InputError` for a missing or invalid manifest.
    """
    manifest = _read_manifest(out)
    camera = CameraConfig(**manifest["camera"])
    texture = TextureConfig(modsem_fraction=manifest["modsem_share"])
    listed = manifest["shards"]
    names = sorted({path.name for path in out.glob("[!.]*.h5")} | set(listed))
    problems = []
    for name in progress(names, f"shards of {out.name}", "shard", len(names)):
        path = out / name
        try:
            if name not in listed:
                raise InputError(f"{path}: expected a shard listed in the manifest, found another one")
            if not path.exists():
                raise InputError(f"{path}: expected a shard, found nothing")
            _check_sum(path, listed[name]["sha256"])
            _check_run(path, manifest["views"], camera, texture, manifest["seed"])
        except InputError as error:
            problems.append(str(error))
    return problems


def _check_sum(path: Path, expected: str) -> None:
    if (found := checksum(path)) != expected:
        raise InputError(f"{path}: expected SHA-256 {expected}, found {found}")


def _check_run(path: Path, views: int, camera: CameraConfig, texture: TextureConfig, seed: int) -> None:
    found = Shard(path, camera, texture)
    if (len(found), found.seed) != (views, seed):
        raise InputError(f"{path}: expected {views} views with seed {seed}, found {len(found)} with seed {found.seed}")


def _read_manifest(out: Path) -> dict[str, Any]:
    path = out / _MANIFEST
    try:
        manifest = json.loads(path.read_text())
        CameraConfig(**manifest["camera"])
        if not all(isinstance(entry["sha256"], str) for entry in manifest["shards"].values()):
            raise TypeError("a shard without SHA-256")
        keys = ("camera", "modsem_share", "seed", "views", "shards")
        return {key: manifest[key] for key in (*keys, *(("heights_m",) if "heights_m" in manifest else ()))}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        found = "nothing" if isinstance(error, FileNotFoundError) else f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: expected a manifest of shards, found {found}") from None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `zerobev generate`."""
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the shards")
    parser.add_argument("--scenes", type=Path, metavar="DIR", help="folder in HM3DSem layout")
    parser.add_argument("--scale", default="reduced", help=f"one of {', '.join(SCALES)} (default: reduced)")
    parser.add_argument("--views", type=int, help="per scene; default: the scale's")
    parser.add_argument("--seed", type=int, default=0)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--workers", type=int, default=1, help="processes on this machine (default: 1)")
    where.add_argument("--dask", metavar="ADDRESS", help="scheduler of a dask cluster with access to both folders")
    parser.add_argument("--verify", action="store_true", help="check the shards in --out instead")


def run(options: argparse.Namespace) -> None:
    """Record or verify the shards of all splits in `--out`; exit code 1 if a scene was skipped or a shard is bad."""
    if options.verify:
        problems = [problem for split in SPLITS for problem in verify(options.out / split)]
        if problems:
            sys.exit("\n".join(problems))
        return
    if options.scenes is None:
        raise InputError("--scenes: expected a folder in HM3DSem layout, found none")
    setting = scale(options.scale)
    views = setting.scenes.views if options.views is None else options.views
    found = split_scenes(options.scenes)
    broken: dict[str, str] = {}
    with cluster(options.dask):
        for split in SPLITS:
            folders, out = list(found.of(split)), options.out / split
            broken |= generate(
                folders,
                out,
                views,
                setting.camera,
                setting.texture,
                options.seed,
                options.workers,
                setting.scenes.heights_m,
            )
    if broken:
        sys.exit("\n".join(f"skipped {name}: {message}" for name, message in broken.items()))
