"""Scenes -> shards: `python -m zerobev.streams.generate --scenes DIR --out DIR --views N --scale S`.

One shard a scene, in parallel over scenes. A shard depends on the scene, the camera, the number of views
and the seed alone, so any number of workers writes the same bytes; a run that was killed goes on where it
was, since a shard that is there is whole.
"""

import argparse
import sys
import zlib
from pathlib import Path

import joblib
import numpy as np

from zerobev import config
from zerobev.config import CameraConfig
from zerobev.errors import InputError, run_command
from zerobev.progress import progress
from zerobev.scenes.hm3dsem import read_scene, split_scenes
from zerobev.storage import write_json
from zerobev.streams.shards import Shard, checksum, write_shard
from zerobev.streams.views import ViewSource


def shard_path(scene_folder: Path, out: Path) -> Path:
    """Where the shard of a scene belongs."""
    return out / f"{scene_folder.name}.h5"


def generate_shard(scene_folder: Path, out: Path, views: int, camera: CameraConfig, seed: int) -> Path:
    """Record `views` views of one scene, unless its shard is there; returns the shard's path.

    Raises `InputError` for a broken scene, and for a shard that is damaged or belongs to another run.
    """
    path = shard_path(scene_folder, out)
    if path.exists():
        found = Shard(path, camera)
        if (len(found), found.seed) != (views, seed):
            expected = f"{views} views with seed {seed}"
            raise InputError(f"{path}: expected {expected}, found {len(found)} with seed {found.seed}")
        return path
    if views < 1:
        raise InputError(f"views: expected 1 or more, found {views}")
    scene = read_scene(scene_folder)
    # the scene's name is part of the seed, so that its views do not depend on which others there are
    rng = np.random.default_rng([seed, zlib.crc32(scene_folder.name.encode())])
    source = ViewSource(scene, camera, rng)
    write_shard(path, scene, (source.draw() for _ in range(views)), camera, seed)
    return path


def generate(
    scene_folders: list[Path], out: Path, views: int, camera: CameraConfig, seed: int, workers: int = 1
) -> dict[str, str]:
    """Record every scene into `out` and write `manifest.json` there (shard -> SHA-256, seed, number of views).

    A broken scene is skipped, and a shard of another run is left alone. Returns what was wrong, scene name ->
    message; empty when all went well.
    """
    missing = [folder for folder in scene_folders if not shard_path(folder, out).exists()]
    jobs = (joblib.delayed(_attempt)(folder, out, views, camera, seed) for folder in missing)
    outcomes = joblib.Parallel(n_jobs=workers, return_as="generator")(jobs)
    shown = progress(outcomes, f"views of {out.name}", "scene", len(missing))
    recorded = (_attempt(folder, out, views, camera, seed) for folder in scene_folders if folder not in missing)
    broken = dict(outcome for outcome in (*shown, *recorded) if outcome)
    shards = sorted(shard_path(folder, out) for folder in scene_folders if folder.name not in broken)
    manifest = {"seed": seed, "views": views, "shards": {path.name: checksum(path) for path in shards}}
    write_json(out / "manifest.json", manifest)
    return broken


def _attempt(folder: Path, out: Path, views: int, camera: CameraConfig, seed: int) -> tuple[str, str] | None:
    try:
        generate_shard(folder, out, views, camera, seed)
    except InputError as error:
        return folder.name, str(error)
    return None


def main() -> None:
    """Parse the command line and generate the shards of every split below `--out`."""
    parser = argparse.ArgumentParser(prog="python -m zerobev.streams.generate", description=__doc__)
    parser.add_argument("--scenes", type=Path, required=True, help="folder in HM3DSem layout")
    parser.add_argument("--out", type=Path, required=True, help="folder for the shards")
    parser.add_argument("--scale", default="reduced", help=f"one of {', '.join(config.SCALES)}")
    parser.add_argument("--views", type=int, help="per scene; default: the scale's")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    scale = config.scale(options.scale)
    views = scale.scenes.views if options.views is None else options.views
    split = split_scenes(options.scenes)
    broken: dict[str, str] = {}
    for name in ("train", "validation", "test"):
        folders = list(getattr(split, name))
        broken |= generate(folders, options.out / name, views, scale.camera, options.seed, options.workers)
    if broken:
        sys.exit("\n".join(f"skipped {name}: {message}" for name, message in broken.items()))


if __name__ == "__main__":
    run_command(main)
